"""What the browser view costs for 4,000 parts: bytes, seconds until shown, updates, clicks.

    python benchmarks/browser_scene.py [FOLDER]

It makes a plant of 114 machines, about 4,000 parts of 114 shapes and 1.9 million triangles, once as
instances of one file and once with a shape of its own for every part, imports them into FOLDER
(a temporary one unless given), and opens each in headless Chromium with software WebGL. Seconds and
frames of the browser are those of this machine's processors; a graphics card is much faster.
"""

import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter, sleep
from typing import TYPE_CHECKING

import numpy as np
import viser
from playwright.sync_api import Page, sync_playwright

from hapticdb.page.scene.view import SceneView
from plant import imported

if TYPE_CHECKING:
    from hapticdb.page.scene.browser import BrowserScene

SECONDS = 120.0
"""Limit of each wait."""
SHELL = "/usr/bin/chromium-headless-shell"
CHROMIUM = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
COUNT_CALLS = """
window.calls = 0; window.frames = []; window.begun = performance.now();
const wrap = (name) => {
  const before = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    window.calls += 1; return before.apply(this, given);
  };
};
['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced'].forEach(wrap);
const tick = () => {
  window.frames.push([performance.now(), window.calls]); window.calls = 0;
  requestAnimationFrame(tick);
};
requestAnimationFrame(tick);
"""
"""Counts the draw calls of each frame, to see when all nodes are drawn."""


@contextmanager
def opened(url: str) -> Iterator[tuple[viser.ViserServer, SceneView, float, float]]:
    """A served scene, and the seconds until boxes and until all shapes were sent."""
    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    began = perf_counter()
    with SceneView(server, url) as view:
        boxes = perf_counter() - began
        assert view.wait_until_shown(SECONDS)
        yield server, view, boxes, perf_counter() - began
    server.stop()


def seconds_until_shown(page: Page) -> tuple[float, int, float]:
    """Seconds until the page's draw calls stop growing, calls and ms a frame then."""
    ends, most, quiet = perf_counter() + SECONDS, 0, 0.0
    while perf_counter() < ends:
        sleep(0.5)
        frames = page.evaluate("window.frames")
        calls = max((n for _, n in frames), default=0)
        quiet = 0.0 if calls > most else quiet + 0.5
        most = max(most, calls)
        if most > 10 and quiet > 4.0:
            break
    begun = page.evaluate("window.begun")
    first = next(at for at, n in frames if n >= 0.98 * most)
    times = [at for at, _ in frames[-15:]]
    frame = (times[-1] - times[0]) / max(len(times) - 1, 1)
    return (first - begun) / 1000, most, frame


def updates_a_second(view: SceneView, seconds: float = 3.0) -> float:
    """Moves of one object that the server makes and sends in a second, as a dragging hand would."""
    moved, began = 0, perf_counter()
    ids = list(view.objects)
    base = view.placement(ids[len(ids) // 2])
    while perf_counter() - began < seconds:
        base[:3, 3] += 1e-4
        view.move(ids[len(ids) // 2], base)
        moved += 1
        sleep(0.001)  # the thread that sends them gets its turn
    return moved / (perf_counter() - began)


def clicks_ms(view: SceneView, n: int = 400) -> tuple[float, float]:
    """Median and 99th percentile of picking, ms, by rays from one eye over the picture."""
    rng = np.random.default_rng(3)
    eye, box = view.framing(), view.box()
    assert eye is not None
    assert box is not None
    taken = []
    for _ in range(n):
        towards = rng.uniform(box[0], box[1]) - eye.position
        began = perf_counter()
        view.pick(eye.position, towards)
        taken.append(1000 * (perf_counter() - began))
    return median(taken), float(np.percentile(taken, 99))


def own_view(view: SceneView, server: viser.ViserServer) -> dict[str, tuple[float, float]]:
    """Milliseconds and MB of what one browser asks for itself."""
    client = next(iter(server.get_clients().values()))
    browser: BrowserScene = view.browser(client)
    ids = list(view.objects)
    asked: dict[str, Callable[[], None]] = {
        "hide one part": lambda: browser.hide(ids[:1]),
        "highlight one part": lambda: browser.highlight(ids[50:51]),
        "isolate a machine": lambda: browser.isolate(ids[:36]),
        "hide one part of each shape": lambda: browser.hide(ids[::30]),
        "show all": browser.show,
    }
    found = {}
    for name, ask in asked.items():
        before, began = browser.bytes_sent, perf_counter()
        ask()
        took = 1000 * (perf_counter() - began)
        found[name] = took, (browser.bytes_sent - before) / 1e6
        browser.show()
    return found


def report(url: str, picture: Path) -> None:
    """Print the figures of one environment, and save what the browser shows."""
    with opened(url) as (server, view, boxes, shapes), sync_playwright() as tools:
        print(f"\n{len(view.objects):,} parts, {view.n_triangles:,} triangles")
        print(f"nodes {view.n_nodes}, {view.bytes_sent / 1e6:.1f} MB to each browser")
        print(f"boxes sent after {boxes:.2f} s, all shapes after {shapes:.2f} s")
        chromium = tools.chromium.launch(executable_path=SHELL, args=CHROMIUM)
        page = chromium.new_page(viewport={"width": 640, "height": 400})
        page.add_init_script(COUNT_CALLS)
        page.goto(f"http://127.0.0.1:{server.get_port()}")
        shown, calls, frame = seconds_until_shown(page)
        print(f"browser: shown after {shown:.1f} s, {calls} draw calls, {frame:.0f} ms a frame")
        print(f"server: {updates_a_second(view):.0f} moves a second, one browser connected")
        half, most = clicks_ms(view)
        print(f"picking: {half:.2f} ms median, {most:.2f} ms at p99")
        for name, (took, size) in own_view(view, server).items():
            print(f"one browser, {name}: {took:.1f} ms, {size:.2f} MB")
        page.set_viewport_size({"width": 1440, "height": 900})
        page.wait_for_timeout(3000)
        page.screenshot(path=picture)
        chromium.close()


def main() -> None:
    """Both plants, in the folder that the command line names or a temporary one."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else made)
        for shared in (True, False):
            name = "instances" if shared else "distinct"
            report(imported(folder, shared=shared), folder / f"{name}.png")


if __name__ == "__main__":
    main()
