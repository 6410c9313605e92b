"""Phrases of docs/scale.md whose figures come from results/shards*.json."""

from collections.abc import Mapping
from typing import Any


def copy_words(results: Mapping[str, Any]) -> list[str]:
    """Rows a second that were copied to one server and to shards."""
    one, *shards = (f"{copy['rows_a_s']:,.0f}" for copy in _rounded(results["copies"]))
    return [f"{one} rows a second", f"{', '.join(shards[:-1])} and {shards[-1]} to 1, 2 and 4"]


def scale_words(results: Mapping[str, Any]) -> list[str]:
    """Objects a second that were copied, and one written anew, on one server and on four shards."""
    one, four = (results["conditions"]["objects"] / copy["s"] for copy in results["copies"])
    anew, anew_on_four = (edit["us"]["p50"] / 1e3 for edit in results["edits"])
    return [
        f"committed {four:.0f} objects a second",
        f"{results['copies'][1]['s']:.0f} s; one server {one:.0f} a second",
        f"took {anew_on_four:.0f} ms ({anew:.0f} ms)",
    ]


def rebalance_words(results: Mapping[str, Any]) -> list[str]:
    """What moved, how long each batch held the lock, and what readers and writers waited."""
    moved, beside = results["rebalance"], results["rebalance"]["beside"]
    batches, writer = moved["batches_us"], beside["writer"]
    before, meanwhile = writer["before_us"], writer["meanwhile_us"]
    return [
        f"{results['conditions']['rows'] + results['conditions']['band_rows']:,} rows",
        f"{max(moved['rows_before']) / min(moved['rows_before']):.1f} times the rows",
        f"balanced in {moved['s']:.1f} s: {moved['rows']:,} rows",
        f"{moved['bytes'] / 1e6:.0f} MB",
        f"{batches['p50'] / 1e6:.2f} s in the median and {batches['max'] / 1e6:.2f} s at most",
        f"from {before['p50'] / 1e3:.0f} to {meanwhile['p50'] / 1e3:.0f} ms",
        f"from {before['max'] / 1e3:.0f} to {meanwhile['max'] / 1e3:.0f} ms",
    ]


def _rounded(copies: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [copy | {"rows_a_s": round(copy["rows_a_s"], -2)} for copy in copies]
