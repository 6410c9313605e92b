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

import numpy as np
import trimesh
from trimesh import creation
from trimesh.transformations import translation_matrix

import hapticdb
import page_tables
import records
from hapticdb import Environment, Extraction, GridOptions, ImportOptions
from hapticdb.extraction.extraction_results import RemovalPath
from hapticdb.ingest.geometry import parts_of
from hapticdb.pointshell.orientation import Surface
from hapticdb.sample import write_sample
from test_mesh_proofs import coal_distance, tree_in_mm

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


def measured(env: Environment, question: Question) -> dict[str, Any]:
    """Search a removal path; of a path that is found, the distance by coal, too."""
    found = hapticdb.extract(
        env, *question.words, exclude=question.exclude, seconds=SECONDS, motions=MOTIONS
    )
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
        way = found.path
        standing = env.select((), (*(obj.id for obj in found.parts), *question.exclude))
        row |= {
            "how": way.how,
            "length_m": way.length,
            "gap_m": way.gap,
            "touching": [[one.object.name, one.until] for one in way.swept.touching],
            "mesh_distance_m": by_meshes(env, found, way, standing),
        }
    return row


def by_meshes(
    env: Environment, found: Extraction, way: RemovalPath, standing: Sequence[hapticdb.Object]
) -> float:
    """Least distance of the exact meshes on the path, of what is not touched at its start."""
    surface = found.shell.surface
    assert isinstance(surface, Surface)
    touched = {one.object.id for one in way.swept.touching}
    free = [obj for obj in standing if obj.id not in touched]
    others = [part.triangles() for _, part in parts_of(env.store, free)]
    scene, tool = tree_in_mm(np.concatenate(others)), tree_in_mm(surface.triangles)
    path = way.swept.path
    poses = path.at(np.linspace(0.0, path.length, MOST_POSES))
    return min(coal_distance(scene, tool, pose) for pose in poses)


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
        inputs = {"model": file.name, "bits": bits, "seconds": SECONDS}
        inputs["voxel_m"] = env.grid.voxel_size
        rows = []
        for question in questions:
            rows.append(measured(env, question))
            print(rows[-1], flush=True)
    return records.conditions() | {"inputs": inputs, "rows": rows}


def main() -> None:
    """Measure, print, and fill the table of docs/paths.md."""
    argparse.ArgumentParser(description=records.first_line(__doc__)).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = {"removal_paths": measure(Path(folder), None, BITS, SAMPLE)}
    records.write(records.ROOT / "results", found)
    page_tables.refill("docs/paths.md", records.ROOT / "results")


if __name__ == "__main__":
    main()
