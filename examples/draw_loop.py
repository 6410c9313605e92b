"""Draws docs/loop.webp: the trunk lid comes out, a wheel is caught, a spanner slides over the car.

Chromium draws the page's own scene; beside the packages of `make test` it needs /usr/bin/chromium*.
"""

import argparse
import io
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from playwright.sync_api import Page, sync_playwright

import hapticdb
from hapticdb import Environment, GridOptions, ImportOptions
from hapticdb.page import colours, tools
from hapticdb.page.drawing import put_at
from hapticdb.page.page_process import new_server, stop
from hapticdb.page.scene.browser_scene import BrowserScene
from hapticdb.page.scene.view import SceneView
from hapticdb.page.site import SceneFacts
from hapticdb.poses import quaternion_of
from hapticdb.sample import write_sample

if TYPE_CHECKING:
    from viser import ClientHandle

Floats = NDArray[np.float64]

SIZE = 640, 360
"""Width and height of the loop, pixels. Larger: a larger file."""
FIRST, LAST, STEP = 80, 368, 12
"""Poses of the sample's path that are shown: over hood and windscreen."""
LIFTS = 10
"""Pictures of each part that moves."""
FRAME_MS, REST_MS = 110, 1400
"""How long a picture is shown, and the last one of a scene."""
TIMEOUT = 120.0
"""Seconds that each wait lasts at most."""
STRIP = 84
"""Height of the strip with the curve, pixels."""
NEWTONS_A_METRE = 90.0
"""Force whose arrow is a metre long. Larger: shorter arrows."""
UP = 0.6
"""Metres that the wheel is pushed up."""
FREE: colours.Colour = (58, 160, 92)
CAUGHT: colours.Colour = (214, 52, 58)
INK = (36, 44, 56)
UNSEEN = (
    "seats", "gearbox", "driveline", "exhaust", "supply", "steering", "cooling", "frame", "engine",
)  # fmt: skip
"""Sub-assemblies under the skin: drawing them in software takes longer than all that is seen."""
VIEWS = {
    "spanner": ((3.0, -1.5, 2.1), (0.95, 0.1, 0.95)),
    "front": ((4.4, 2.9, 2.2), (0.7, 0.2, 0.85)),
    "rear": ((-5.2, 2.7, 2.3), (-1.3, 0.2, 0.75)),
}
"""Place of the eye, and what it looks at, metres."""


class _Stage(NamedTuple):
    """The page of one browser, and what moves in it."""

    env: Environment
    view: SceneView
    client: "ClientHandle"
    looks: BrowserScene
    page: Page


def _look(stage: _Stage, name: str) -> None:
    """Put the eye at one of the `VIEWS`."""
    eye, target = VIEWS[name]
    camera = stage.client.camera
    with stage.client.atomic():
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position, camera.look_at = eye, target


def _drawn(stage: _Stage) -> Image.Image:
    """One picture of the scene, without panels."""
    stage.client.flush()
    stage.page.wait_for_timeout(100)
    return Image.open(io.BytesIO(stage.page.screenshot())).convert("RGB").resize(SIZE)


def _font(size: int) -> ImageFont.FreeTypeFont:
    from matplotlib import font_manager  # noqa: PLC0415 - slow, and only for its font

    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), size)


def _captioned(picture: Image.Image, text: str, colour: tuple[int, int, int] = INK) -> Image.Image:
    ImageDraw.Draw(picture).text((18, 14), text, fill=colour, font=_font(20))
    return picture


def _curve(picture: Image.Image, forces: Floats, now: int, top: float) -> Image.Image:
    """Draw the force up to now in a strip at the bottom."""
    draw = ImageDraw.Draw(picture, "RGBA")
    width, height = picture.size
    draw.rectangle((0, height - STRIP, width, height), fill=(255, 255, 255, 215))
    x = np.linspace(18, width - 90, len(forces))
    y = height - 12 - (STRIP - 26) * forces / top
    draw.line(list(zip(x[: now + 1], y[: now + 1], strict=True)), fill=colours.FORCE, width=3)
    draw.ellipse((x[now] - 5, y[now] - 5, x[now] + 5, y[now] + 5), fill=colours.FORCE)
    draw.text((width - 84, height - 52), f"{forces[now]:.1f} N", fill=INK, font=_font(18))
    return picture


def spanner(stage: _Stage, tool: Path, path: Path) -> Iterator[Image.Image]:
    """Pictures of the spanner that slides under the distance law, with its force."""
    shell = stage.env.tool(tool)
    poses = hapticdb.read_poses(path)[FIRST:LAST]
    batch = stage.env.touch(shell, poses=poses).forces
    forces = np.linalg.norm(batch, axis=1)
    held = tools.from_files([str(tool)], stage.env.grid.voxel_size, has_distances=True)[0]
    scene = stage.client.scene
    node = scene.add_mesh_simple(
        "/spanner",
        held.vertices,
        held.faces,
        color=colours.of_tool(0),
        flat_shading=True,
        side="double",
    )
    arrow = scene.add_arrows(
        "/arrow", np.zeros((1, 2, 3)), colours.FORCE, shaft_radius=0.02, head_radius=0.05,
        head_length=0.1,
    )  # fmt: skip
    _look(stage, "spanner")
    for n in range(0, len(poses), STEP):
        place = poses[n][:3, 3]
        with stage.client.atomic():
            put_at(node, np.concatenate([place, quaternion_of(poses[n][None, :3, :3])[0]]))
            arrow.points = np.array([[place, place + batch[n] / NEWTONS_A_METRE]], dtype=np.float32)
        picture = _curve(_drawn(stage), forces, n, 1.1 * float(forces.max()))
        yield _captioned(picture, "Feel: a spanner slides over the car")
    node.remove()
    arrow.remove()


def moving(
    stage: _Stage, ids: list[int], poses: Floats, colour: colours.Colour, text: str, view: str
) -> Iterator[Image.Image]:
    """Pictures of parts on the straight way between two displacements (2, 4, 4)."""
    for i in ids:
        stage.view.contents._members[i].colour = colour  # noqa: SLF001 - for the picture
    stage.looks.hide(ids)
    stage.looks.show(ids)
    _look(stage, view)
    starts = {i: stage.env.object(i).transform for i in ids}
    for share in 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, LIFTS)):
        for object_id, start in starts.items():
            moved = start.copy()
            moved[:3, 3] += share * (poses[-1, :3, 3] - poses[0, :3, 3])
            stage.view.move(object_id, moved)
        yield _captioned(_drawn(stage), text, colour)
    for object_id, start in starts.items():
        stage.view.move(object_id, start)
    stage.looks.hide(ids)


def lid(stage: _Stage) -> Iterator[Image.Image]:
    """Pictures of the trunk lid on its removal path."""
    found = hapticdb.extract(stage.env, "body/trunk_lid")
    if found.path is None:
        raise SystemExit("the trunk lid does not come out")
    ids = [obj.id for obj in found.parts]
    text = f"Extract: the trunk lid comes out, {found.path.length:.2f} m, proved"
    yield from moving(stage, ids, found.path.poses, FREE, text, "rear")


def wheel(stage: _Stage) -> Iterator[Image.Image]:
    """Pictures of a wheel that is pushed up, as far as it is free."""
    env, ids = stage.env, [obj.id for obj in stage.env.find("wheels/*_front_left*")]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 2, 3] = UP
    first = hapticdb.sweep(env, env.shell(*ids), poses, exclude=ids, seated=True).hits[0]
    poses[1, 2, 3] *= first.fraction
    name = first.object.name.rpartition("/")[2].replace("_", " ")
    yield from moving(
        stage, ids, poses, CAUGHT, f"Sweep: the wheel is caught by the {name}", "front"
    )


def main() -> None:
    """Draw the loop."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", nargs="?", default="docs/loop.webp")
    out = Path(parser.parse_args().out)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        files = write_sample(folder)
        url = Path(folder) / "car.db"
        grid = GridOptions(bits=10, extent=1.6)
        hapticdb.import_files(url, [files.car], ImportOptions(grid=grid))
        browser = play.chromium.launch(
            executable_path="/usr/bin/chromium-headless-shell",
            args=[
                "--no-sandbox",
                "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--disable-gpu-compositing",
                "--disable-gpu-vsync",
            ],
        )
        server = new_server()
        server.scene.world_axes.visible = False
        page = browser.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(1000.0 * TIMEOUT)
        with (
            closing(SceneView(server, str(url))) as view,
            hapticdb.open(url, read_only=True) as env,
        ):
            page.goto(f"http://127.0.0.1:{server.get_port()}/?fixedDpr=1&hideViserLogo")
            end = time.monotonic() + TIMEOUT
            while (view.contents.waiting() or not server.get_clients()) and time.monotonic() < end:
                page.wait_for_timeout(500)
            page.add_style_tag(
                content="#webgl-software-rendering,[data-testid^=floating-panel]{display:none}"
            )
            (client,) = server.get_clients().values()
            looks = BrowserScene(
                client, view.contents, view.up, float(SceneFacts.of(view).bounds[0, view.up])
            )
            stage = _Stage(env, view, client, looks, page)
            stage.looks.hide(obj.id for word in UNSEEN for obj in env.find(f"{word}/*"))
            page.wait_for_timeout(1000)
            pictures, rests = [], []
            for scene in (
                lid(stage),
                wheel(stage),
                spanner(stage, files.spanner, files.path),
            ):
                shown = list(scene)
                pictures += shown
                rests += [FRAME_MS] * (len(shown) - 1) + [REST_MS]
        stop(server)
        browser.close()
    pictures[0].save(
        out, save_all=True, append_images=pictures[1:], duration=rests, loop=0, quality=72, method=4
    )
    print(f"{out}: {len(pictures)} pictures, {out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
