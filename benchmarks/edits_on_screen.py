"""From the commit of an edit until a browser's picture has changed, with software WebGL.

    python benchmarks/edits_on_screen.py

Three scenes: the sample's wrench alone, the car (the real one where HAPTICDB_TEST_DATA has it), and
a plant of 4,104 parts and 2.19 million triangles. A server runs in a process of its own, a browser
looks at its page, and this process moves an object back and forth in the database. The browser
compares every picture that it draws with the one before, so the time is that of the first picture
with the object at its new place. Beside it stand the time until the browser has the message, and
what it takes for any picture of that scene: without a graphics card, most of the time is that.
"""

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, ViewportSize, sync_playwright

import hapticdb
from hapticdb import GridOptions, ImportOptions
from hapticdb.bench import records
from hapticdb.sample import write_sample
from plant import imported
from served import TOKENS, ServedProcess, car_or_sample

SHELL = "/usr/bin/chromium-headless-shell"
CHROMIUM = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SIZE: ViewportSize = {"width": 640, "height": 400}
EDITS, UNCOUNTED = 24, 3
PATIENCE = 120.0
"""Seconds of each wait at most."""
REST = 1.0
"""Least seconds of rest before an edit, so that the scene is drawn in full. Up to half as much is
added at random, since edits at even times would meet the browser at one moment of its frame."""
SEEN = 0.1
"""Length of a move as a share of the scene's diagonal. Larger: more pixels change."""
BITS = 9
"""Bits an axis of the car's grid."""
WATCH = """
window.changes = []; window.arrivals = []; window.taken = []; window.calls = 0; window.last = 0;
const given = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
  const context = given.call(this, kind, {...options, preserveDrawingBuffer: true});
  if (kind.startsWith('webgl') && context) window.watched = context;
  return context;
};
for (const name of ['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced']) {
  const before = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...given) {
    window.calls += 1; return before.apply(this, given);
  };
}
const Made = window.Worker;
window.Worker = function (...given) {
  const worker = new Made(...given);
  worker.addEventListener('message', () => window.arrivals.push(Date.now()));
  return worker;
};
const look = () => {
  if (window.watched && window.calls) {
    const gl = window.watched, before = performance.now();
    const width = gl.drawingBufferWidth, height = gl.drawingBufferHeight;
    const words = new Uint32Array(width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(words.buffer));
    window.taken.push(performance.now() - before);
    let sum = 0;
    for (let at = 0; at < words.length; at++) sum = (Math.imul(sum, 31) + words[at]) | 0;
    if (sum !== window.last) { window.changes.push(Date.now()); window.last = sum; }
    window.calls = 0;
  }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""
"""Reads each picture back, which waits until it is drawn. Notes by the system's clock, in ms, when
one differs from the last, and when messages come from the thread that holds the connection."""


def wait_until(holds: Callable[[], bool], page: Page, what: str) -> None:
    """Wait until something holds, and let the page go on meanwhile."""
    end = time.monotonic() + PATIENCE
    while not holds():
        if time.monotonic() > end:
            raise TimeoutError(f"{what}: not within {PATIENCE:g} s")
        page.wait_for_timeout(20)


def rest(page: Page, seconds: float) -> None:
    """Wait until no picture has changed for some seconds and the time of six pictures more.

    After an edit, viser draws up to four.
    """

    def rests() -> bool:
        return bool(
            page.evaluate(
                f"Date.now() - window.changes.at(-1) > {1000 * seconds} + 6 * window.taken.at(-1)"
            )
        )

    wait_until(lambda: bool(page.evaluate("window.changes.length")), page, "the first picture")
    wait_until(rests, page, "a picture at rest")


def first_after(page: Page, times: str, known: int, committed: float) -> float:
    """Milliseconds from a commit until the next entry of the page's times, which may yet come."""
    wait_until(lambda: page.evaluate(f"window.{times}.length") > known, page, times)
    return float(page.evaluate(f"window.{times}[{known}]")) - committed


def edit_and_look(env: hapticdb.Environment, page: Page) -> dict[str, list[float]]:
    """Milliseconds from each commit until the page has the message, and until it shows the edit."""
    obj = max(env.objects(), key=lambda one: float(np.ptp(one.bounds, axis=0).prod()))
    places = [obj.transform.copy(), obj.transform.copy()]
    scene = np.concatenate([one.bounds for one in env.objects()])
    places[1][2, 3] -= SEEN * float(np.linalg.norm(np.ptp(scene, axis=0)))
    rng = np.random.default_rng(7)
    found: dict[str, list[float]] = {"arrivals": [], "changes": []}
    for n in range(-UNCOUNTED, EDITS):
        rest(page, REST * rng.uniform(1.0, 1.5))
        known = {times: page.evaluate(f"window.{times}.length") for times in found}
        env.move(obj.id, places[n % 2])
        committed = 1000 * time.time()
        for times, number in known.items():
            after = first_after(page, times, number, committed)
            if n >= 0:
                found[times].append(after)
    return found


def row(name: str, url: str, folder: Path) -> str:
    """Row of the table for one scene."""
    with (
        ServedProcess(url, folder) as server,
        hapticdb.open(url) as env,
        sync_playwright() as tools,
    ):
        chromium = tools.chromium.launch(executable_path=SHELL, args=CHROMIUM)
        page = chromium.new_page(viewport=SIZE)
        page.add_init_script(WATCH)
        page.goto(f"http://127.0.0.1:{server.port}/?token={TOKENS['viewer']}")
        page.wait_for_selector("canvas")  # after the token has become a cookie
        found = edit_and_look(env, page)
        picture = float(np.median(page.evaluate(f"window.taken.slice(-{EDITS})")))
        chromium.close()
        columns = [
            "{:.0f} / {:.0f}".format(*np.percentile(times, [50, 100])) for times in found.values()
        ]
        return f"| {name} | {len(env.objects()):,} | {' | '.join(columns)} | {picture:.0f} |"


def main() -> None:
    """Measure each scene and print the table."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        sample = write_sample(folder / "sample")
        wrench = str(folder / "wrench.db")
        hapticdb.import_files(wrench, [sample.wrench], ImportOptions(grid=GridOptions(bits=BITS)))
        car = car_or_sample(folder, sample.car, BITS)
        print("| scene | parts | in the browser after, ms | on screen after, ms | a picture, ms |")
        print("| --- | --- | --- | --- | --- |")
        plant = imported(folder, shared=True)
        for name, url in (("wrench", wrench), (Path(car).stem, car), ("plant", plant)):
            print(row(name, url, folder), flush=True)
        print(f"\n{records.commit()}, median / greatest of {EDITS} edits")


if __name__ == "__main__":
    main()
