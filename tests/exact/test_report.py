"""What is told of a sweep: the verdict's line."""

import numpy as np
import pytest

from hapticdb import PointShell
from hapticdb.exact.sweep_report import gap_text, verdict_line
from hapticdb.exact.swept import Gap, Swept
from made_sweeps import CORNERS, line, place_at, swept, thing, touching

PATH = line()
BENT = line((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 0.5, 0.0))
TOOL = PointShell(CORNERS, CORNERS / np.linalg.norm(CORNERS, axis=1)[:, None], np.zeros(3))
BOLT, SEAT, LID = thing("bolt", 1), thing("seat", 2), thing("lid", 3)
GAP = Gap(4e-4, 4.01e-4, place_at(BOLT, 0.312, PATH, 4e-4))
HIT = place_at(SEAT, 0.25, PATH)
DEEP = HIT._replace(at_least=2e-3)


@pytest.mark.parametrize(
    ("found", "verdict", "told"),
    [
        (swept(gap=GAP), "clear", "clear by 0.4 mm: nearest bolt at 31.2 % of the path"),
        (swept(BENT, gap=Gap(4e-4, 4e-4, place_at(BOLT, 0.75, BENT))), "clear",
         "clear by 0.4 mm: nearest bolt at 75 % of the path (segment 1)"),
        (swept(gap=Gap(0.5, 0.5, None)), "clear", "clear: nothing nearer than 0.5 m"),
        (swept(gap=GAP, touching=(touching(SEAT, 0.12, is_sliding=True), touching(LID, 1.0))),
         "slides",
         ("slides along seat until 12 % of the path, otherwise clear by 0.4 mm: nearest bolt at "
         "31.2 % of the path; touches lid to the end of the path")),
        (swept(hits=tuple(place_at(one, 0.312, PATH) for one in (BOLT, SEAT, LID))), "hits",
         "hits bolt at 31.2 % of the path; then seat, lid"),
        (swept(hits=(DEEP,), touching=(touching(SEAT, 0.25),)), "hits",
         "goes into seat at 25 % of the path: at least 2 mm"),
        (swept(hits=(HIT,), touching=(touching(SEAT, 0.25),)), "hits",
         "goes into seat at 25 % of the path by more than the tolerance"),
        (swept(hits=(DEEP,), touching=(touching(SEAT, 0.0, by="", start=np.inf),)), "hits",
         "starts inside seat: at least 2 mm"),
        (swept(gap=GAP, touching=(touching(SEAT, 0.1, start=5e-4), touching(LID, 0.0))), "overlaps",
         ("clear by 0.4 mm: nearest bolt at 31.2 % of the path, but for overlaps at the start: "
          "seat 0.5 mm; touches seat, lid until 10 % of the path")),
        (swept(gap=GAP, touching=(touching(SEAT, 0.1, start=5e-4),), overlap=1e-3), "clear",
         "touches seat until 10 % of the path"),
        (swept(hits=(place_at(SEAT, 0.8, PATH),), touching=(touching(SEAT, 0.1),)), "hits",
         "leaves seat and hits it again at 80 % of the path"),
        (swept(enclosed=(thing("tank", 4, 1.0), thing("pea", 5, 1e-3)), hits=(HIT,)), "hits",
         "lies inside tank; pea lies inside the tool; hits seat at 25 % of the path"),
        (swept(leaky=(SEAT, LID)), "not decided",
         "not decided: seat, lid around the tool or inside it, and not watertight"),
    ],
)  # fmt: skip
def test_verdict_line_cases(found: Swept, verdict: str, told: str) -> None:
    assert found.verdict == verdict
    assert told in verdict_line(found, TOOL)


def test_verdict_line_time_limit() -> None:
    assert verdict_line(swept(is_stopped=True), TOOL).startswith("not decided: the time was over")
    late = swept(is_stopped=True, hits=(place_at(BOLT, 0.5, PATH),))
    assert late.verdict == "hits"
    assert "the time was over" in verdict_line(late, TOOL)


def test_gap_text_bounds() -> None:
    assert [gap_text(swept(gap=gap)) for gap in (GAP, Gap(0.5, 0.5, None), swept().gap)] == [
        "0.4 mm", "more than 0.5 m", "-",
    ]  # fmt: skip
