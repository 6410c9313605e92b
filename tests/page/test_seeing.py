"""What a person sees of jobs and parts, without a browser."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from hapticdb.errors import UsageError
from hapticdb.kernels._sets import building
from hapticdb.page.panels.working import COMPILES, WAITS, Progress, Work
from page_scene import page_of, two_parts


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return two_parts(tmp_path_factory.mktemp("seen"))


def test_a_job_says_what_is_done_and_then_its_result_stays() -> None:
    said: list[str] = []
    with ThreadPoolExecutor(1) as threads:
        site = SimpleNamespace(sweeping=threads)
        browser: Any = SimpleNamespace(site=site, has_gone=False, works=[])
        work = Work(browser, MagicMock(), "a search", "pairs")

        def note() -> None:
            work.tick()
            said.append(work.said.content)

        def job(progress: Progress) -> None:
            note()
            building.add("triangles")
            note()
            building.clear()
            progress(372, 1163)
            note()
            with pytest.raises(UsageError, match="a search is running"):
                work.begin(job, print)

        def show(_: None) -> None:
            work.said.content = "2 pairs"
            note()

        work.begin(job, show)
    assert browser.works == [work]
    for words, text in zip(("Reads the parts.", COMPILES, "1,163 pairs: 31 %"), said, strict=False):
        assert words in text
    assert said[3] == "2 pairs"
    assert not any(WAITS in text for text in said)


def test_the_shadow_is_that_of_what_is_shown(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    monkeypatch.setattr(
        "hapticdb.page.scene.browser.add_shadow", lambda _, boxes, *__: drawn.append(boxes)
    )
    with page_of(scene) as (site, _, browser):
        (box, ball) = site.objects.values()
        browser.scene.hide([ball.id])
        assert np.allclose(drawn[-1], [box.bounds], atol=1e-6)
        browser.scene.isolate([])
        assert drawn[-1].shape == (0, 2, 3)
        browser.scene.show()
        assert len(drawn[-1]) == 2
