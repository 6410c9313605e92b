"""Ways out: which parts are found to come out, how soon, and what exact meshes say of the paths.

    python benchmarks/removal_paths.py      # questions of the sample car

coal compares the triangles of the part with those of all that stands, at places of each found path.
So neither voxels nor triangle code of hapticdb take part in its answer.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh import creation
from trimesh.transformations import translation_matrix

import hapticdb
import page_tables
import records
from batch_peers import mesh_of, tree_of_boxes
from hapticdb import Environment, Extraction, GridOptions, ImportOptions
from hapticdb.extraction.extraction_results import RemovalPath
from hapticdb.ingest.geometry import parts_of
from hapticdb.pointshell.orientation import Surface
from hapticdb.sample import write_sample

Floats = NDArray[np.float64]
BITS = 11
SECONDS = 60.0
MOTIONS = 20_000
MOST_POSES = 4000
"""Places of a path that coal looks at."""


class Question(NamedTuple):
    """Which parts are to come out, and what was taken off before."""

    words: tuple[str, ...]
    exclude: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return ", ".join(self.words) + (f" without {', '.join(self.exclude)}" * bool(self.exclude))


WHEEL = ("wheels/tyre_front_left", "wheels/rim_front_left")
BOLTS = ("wheels/wheel_bolt_front_left_*",)
AROUND_BATTERY = ("supply/wiring_harness", "body/hood", "body/hood_lining")
AROUND_SEAT = (
    "cabin/floor_pan",
    "cabin/carpet",
    "body/door_front_left",
    "cabin/door_trim_front_left",
)
SAMPLE = (
    Question(("wheels/wheel_bolt_front_left_1",)),
    Question(WHEEL, BOLTS),
    Question(WHEEL),
    Question(("body/hood",)),
    Question(("supply/battery",)),
    Question(("supply/battery",), AROUND_BATTERY),
    Question(("seats/seat_*_left",), AROUND_SEAT),
    Question(("engine/spark_plug",), ("body/hood*",)),
)
"""Of the sample car. Bolts hold the wheel; the harness lies over the battery, and the seat stands
on the floor. Without floor, carpet and door the seat goes forward, up, and then out by the door.
The spark plug, which is added to the car, comes out along its bore."""
SEAT = (1.15, 0.40, 0.80)
"""Middle of the spark plug's seat in the engine bay, metres."""
BORE, PLUG, SEAT_RADIUS = 0.024, 0.012, 0.045
"""Radii of the seat's bore, which is closed below, of the plug and of the seat, metres: 3.6 voxels
between bore and plug."""


def plug_scene() -> Any:  # noqa: ANN401 - trimesh has no types
    """A spark plug in a round seat whose bore is along z and open at the top only."""
    bored = creation.annulus(BORE, SEAT_RADIUS, 0.05)
    bottom = creation.cylinder(SEAT_RADIUS, segment=[[0.0, 0.0, -0.035], [0.0, 0.0, -0.025]])
    profile = [(0, 0), (0.008, 0), (PLUG, 0.002), (PLUG, 0.05), (0.006, 0.055), (0.005, 0.09)]
    plug = creation.revolve([*profile, (0, 0.09)], sections=24)
    plug.apply_translation([0.0, 0.0, -0.012])
    scene = trimesh.Scene()
    scene.graph.update(frame_to="engine", matrix=translation_matrix(SEAT))
    scene.add_geometry(bored + bottom, "spark_plug_seat", parent_node_name="engine")
    scene.add_geometry(plug, "spark_plug", parent_node_name="engine")
    return scene


def measured(url: Path, question: Question, seconds: float, motions: int) -> dict[str, Any]:
    """Search a way out; for a path that is found, ask coal, too."""
    with hapticdb.open(url, read_only=True) as env:
        found = hapticdb.extract(
            env, *question.words, exclude=question.exclude, seconds=seconds, motions=motions
        )
        return _record(env, question, found)


def _record(env: Environment, question: Question, found: Extraction) -> dict[str, Any]:
    row: dict[str, Any] = {
        "parts": question.name,
        "verdict": found.verdict,
        "s": found.seconds,
        "pulls": found.pulls,
        "motions": found.motions,
        "poses": found.poses,
        "blockers": [[one.object.name, one.pulls] for one in found.blockers[:3]],
    }
    if found.path is not None and found.is_free:
        standing = env.select((), (*(obj.id for obj in found.parts), *question.exclude))
        row |= _of_way(found.path) | by_meshes(env, found, standing)
    return row


def _of_way(way: RemovalPath) -> dict[str, Any]:
    return {
        "how": way.how,
        "length_m": way.length,
        "end_m": way.poses[-1][:3, 3].tolist(),
        "gap_m": way.gap,
        "touching": [[one.object.name, one.until] for one in way.swept.touching],
    }


def by_meshes(
    env: Environment, found: Extraction, standing: Sequence[hapticdb.Object]
) -> dict[str, Any]:
    """Least distance of the exact meshes on the path, of what is not touched at its start.

    coal measures in millimetres: in metres its tolerances are as large as small triangles.
    """
    way, surface = found.path, found.shell.surface
    assert way is not None
    assert isinstance(surface, Surface)
    path = way.swept.path
    ways = np.linspace(0.0, path.length, MOST_POSES)
    touched = {one.object.id for one in way.swept.touching}
    free = [obj for obj in standing if obj.id not in touched]
    others = [part.triangles() for _, part in parts_of(env.store, free)]
    tool = tree_of_boxes(*mesh_of(1e3 * surface.triangles))
    scene = tree_of_boxes(*mesh_of(1e3 * np.concatenate(others)))
    here, request = coal.Transform3s(), coal.DistanceRequest()
    least = np.inf
    for pose in path.at(ways):
        there = coal.Transform3s(pose[:3, :3].copy(), 1e3 * pose[:3, 3])
        result = coal.DistanceResult()
        least = min(least, coal.distance(scene, here, tool, there, request, result))
    return {"mesh_distance_m": 1e-3 * float(least)}


def measure(
    folder: Path, model: Path | None, bits: int, questions: Sequence[Question]
) -> dict[str, Any]:
    """Import the model, the sample car with a spark plug unless one is given, and ask all."""
    file = model or write_sample(folder / "sample").car
    files = [file]
    if model is None:
        files.append(folder / "plug.glb")
        files[1].write_bytes(plug_scene().export(file_type="glb"))
    url = folder / "scene.db"
    hapticdb.import_files(url, files, ImportOptions(grid=GridOptions(bits=bits)))
    with hapticdb.open(url, read_only=True) as env:
        voxel_size = env.grid.voxel_size
    found: dict[str, Any] = records.conditions() | {
        "inputs": {"model": file.name, "bits": bits, "seconds": SECONDS, "voxel_m": voxel_size},
        "rows": [],
    }
    for question in questions:
        found["rows"].append(measured(url, question, SECONDS, MOTIONS))
        print(_line(found["rows"][-1]), flush=True)
    return found


def _line(row: dict[str, Any]) -> str:
    said = f"{row['parts']}: {row['verdict']}, {row['s']:.1f} s"
    if "length_m" in row:
        said += f", {1000 * row['length_m']:.0f} mm"
        said += f", gap {1000 * row['gap_m']:.2f} mm; meshes {1000 * row['mesh_distance_m']:.2f} mm"
    return said + "".join(f"; {name} stops {pulls}" for name, pulls in row["blockers"][:1])


def main() -> None:
    """Measure, print, and fill the table of docs/paths.md."""
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {"removal_paths": measure(Path(folder), None, BITS, SAMPLE)}
    records.write(Path("results"), found)
    page_tables.refill("docs/paths.md", Path("results"))


if __name__ == "__main__":
    main()
