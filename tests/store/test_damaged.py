"""A short run of `damaging`: no damaged environment answers wrongly; `check` finds each one."""

from pathlib import Path

import pytest

from damaging import WRONG, is_missed, outcomes, samples_in
from draws import is_every


@pytest.mark.parametrize(
    "cases", [40, pytest.param(1000 if is_every() else 200, marks=pytest.mark.long)]
)
def test_damage_is_told_or_harmless_and_found_by_check(tmp_path: Path, cases: int) -> None:
    found = list(outcomes(samples_in(tmp_path), tmp_path, range(cases), seed=1))
    assert len(found) == cases
    assert [o for o in found if o.read in WRONG or o.check in WRONG or is_missed(o)] == []
    assert {o.read for o in found} >= {"told", "right"}
