"""Arguments and options of the verbs: value, default and help of each, in one place."""

import re
from collections.abc import Callable
from dataclasses import is_dataclass
from functools import partial, wraps
from inspect import Parameter, Signature, signature
from typing import Annotated, Any, Literal

import typer

from hapticdb.cli.values import point_of, size_of
from hapticdb.units import NAMES, angle_of, length_of, volume_of

StrategyName = Literal["auto", "statement", "array", "points", "maxgap", "cbgroup"]
CurveName = Literal["z", "hilbert", "lexicographic"]
LayoutName = Literal["brick", "voxel"]
LawName = Literal["plane", "distance"]
RenderingName = Literal["coupled", "direct"]
FramesOn = Literal["cpu", "cuda"]
UnitName = Literal["um", "mm", "cm", "m", "km", "in", "ft", "us-ft", "yd"]
RightName = Literal["viewer", "toucher", "editor", "nobody"]

TEXTS = """
url URL: The environment: a path, sqlite:///path, postgresql://host/database.
objects WORDS...: As 'hapticdb objects' lists them.
json: Print JSON, an object a line.
csv FILE: Write the result as CSV to a new file; - is standard output.

where WORDS: Only these objects.
exclude WORDS: Leave these objects out.
tool FILE: Mesh of the tool, or a shell saved as .npz.
tool_unit: Unit of a tool whose file names no unit; metres unless given.
path_unit [m]: Unit of the positions of the poses.
points N [300]: Points of the shell.
seed N [0]: Seed of the points' places.
stiffness N/M: Stiffness of the force law.
law: Force law of a frame: the tangent plane of a voxel, or a penalty on the distance to surfaces;
  distance unless given where every object has distances.
conservative: Leave the tool's points on its surface, so that clearance is kept: with distances
  contact begins 1.5 voxels before the surface. Otherwise points are drawn inward by 1.5 voxels, and
  it begins at the surface.
budget SIZE [256MiB]: Memory for resident cells, MiB or such as 4GiB.
on ADDRESS: Have workers of dask.distributed do it: its scheduler, tcp://host:8786.
layout [brick]: Index table of a new environment.
curve [z]: Order of the keys of a new environment.
machine FILE: A machine with joints, URDF, or MJCF (extra machines).
joints CSV: Its path: a column a joint, rad or m, or a header such as 'elbow [deg]'.
srdf FILE: Pairs of its links that are not tested.
at POSE [the world's frame]: Where its base stands: x,y,z,qw,qx,qy,qz, millimetres, or such as
  0,5,0.2in,1,0,0,0; or a CSV file of one pose, metres.
contact LENGTH/mm [0.05]: what is so near where the path starts may be touched; a motion by so much
  has to free the tool from it all along.
overlap LENGTH/mm [0]: by so much a part may overlap others where it stands.

import.files FILE...: GLB, glTF, OBJ, STL, PLY, 3MF, OFF, DAE; STEP, IFC, LAS and LAZ with their
  extras.
import.unit: Unit of files that name no unit; metres unless given.
import.bits 1..21 [10]: Bits of each axis: 2^bits voxels.
import.voxel_size LENGTH/m: edge of a voxel.
import.extent FACTOR [1.6]: Edge of the grid: so many times the longest side of the bounding box of
  all files.
import.origin X,Y,Z/m [so that the files are in its middle]: lower corner of the grid.
import.jobs N [one a processor]: Threads.
import.keep_removed: Leave out parts that were removed.
import.time_limit SECONDS [20 and more by its size]: Time that reading one file may take.
import.memory_limit SIZE [512 and more by its size]: Memory that reading one file may take, MiB or
  such as 4GiB.
import.voxel_limit N [a minute's work]: Voxels that the surfaces of one file may meet, by their
  area.
import.replace: Replace objects of these files by what the files hold now.
import.distances [yes for bricks]: Store distances to surfaces, which coupled sessions need, in a
  new environment.
import.chord LENGTH/mm [0.01, IFC 0.1]: chord error of STEP and IFC files, how far triangles may lie
  from the surfaces.
import.partitions SERVERS: A new environment on PostgreSQL: hosts or URLs, with commas between, of
  the servers that get its rows.

info.calibrate: Measure what queries cost on this machine, and keep it.
info.cold: With --calibrate: measure with empty caches, on SQLite.

objects.name WORDS: Only these objects.
objects.limit N [40 on a terminal, all in a pipe]: Objects to list; 0: all.

touch.poses FILE: Poses x,y,z,qw,qx,qy,qz with a header, a TUM trajectory, a path as OMPL prints it,
  or a .npy of (M, 4, 4) or (M, 7) numbers.
touch.strategy: How the database is asked.
touch.maxgap KEYS: Widest gap that the strategy maxgap reads across, in voxel keys.
touch.contacts_csv FILE: Write every contact as CSV to a new file; - is standard output.
touch.out FILE: Feel all poses as a batch, and write a table to a new file: .csv, .parquet or .npz.
touch.on cpu|cuda|ADDRESS [cpu]: With --out, what computes: the processors, a GPU of NVIDIA, or
  workers of dask.distributed, by their scheduler, tcp://host:8786.

feel.device DEVICE: The hand: poses in a .csv (column t: seconds), a recording .hdbrec, random,
  force-dimension, openhaptics or haply.
feel.rate HZ: Frames a second.
feel.seconds S: How long; unless given, until the device ends or Ctrl-C.
feel.speed M/S: Speed along a path, or greatest speed of a random hand.
feel.at X,Y,Z/m: where the hand random is.
feel.simulate: Let the force push the hand, as a simulated device.
feel.loop: Begin a path again at its end.
feel.scale N: Metres in the scene for each metre of the hand.
feel.clutch BUTTON: While this button is down, only the hand moves; 0 is the first.
feel.record FILE: Record the session: a new .hdbrec.
feel.replace: Replace a recording that exists, once there is a first frame.
feel.record_limit SIZE [4GiB]: Size at which the recording ends and the session goes on: MiB, or
  such as 4GiB. It also ends when its disk has 64 MiB left.
feel.frames_on: What finds the tool's points near surfaces: a processor, or a GPU of NVIDIA for
  tools of millions of points.
feel.rendering [coupled; direct with --law plane]: coupled: a spring between hand and tool, which
  stays outside of surfaces; needs distances. direct: each frame's wrench goes to the device, up to
  its caps.
feel.stiffness N/M [the device's, or 1000]: Stiffness that the hand feels; lowered to what the
  device holds without trembling. With --rendering direct: of a contact.
feel.device_profile NAME [the device's own]: What the device renders: touch, omni, desktop,
  premium-1.5, falcon, omega, delta or sigma.7.
feel.cap N [the device's]: Greatest force.
feel.delay MS [the device's, or one period]: Milliseconds from reading the hand's place until its
  force acts.
feel.seed N [0]: Seed of the points' places, and of a random hand.
feel.processor N: Bind the loop to that processor.
feel.no_baseline: Skip the empty loop that is measured before, for 2 s at most.

view.tool FILE: Mesh of a tool to choose from, beside a ball and a peg.
view.tool_unit: Unit of tools whose files name no unit; metres unless given.
view.rendering [coupled where there are distances]: coupled: a spring between hand and tool, which
  stays outside of surfaces; needs distances. direct: the wrench of each frame, capped.
view.recordings FOLDER: Folder in which people's sessions may be recorded.
view.seconds S [Ctrl-C]: End that long after the start.
view.no_browser: Print the address, and open no browser.

serve.token: Ask for a token. One is made for each role, and printed at the start.
serve.token_file FILE: Tokens of yours, 16 characters or more: a file with ROLE=TOKEN on each line.
  Roles: viewer, toucher, editor.
serve.role_url ROLE=URL: Address of the environment for a role, with the rights of a user of the
  database.
serve.host ADDRESS: Address to listen on; 0.0.0.0 is all of them.
serve.port N: Port to listen on; 0 is a free one.
serve.prefix /PATH: Path under which a proxy hands requests on.
serve.host_name NAME: Name of this server for browsers, such as that of a proxy.
serve.tls_cert FILE: Certificate of TLS, PEM.
serve.tls_key FILE: Key of the certificate, PEM.
serve.log_json: Write the log as JSON, an object a line.

replay.recording FILE: A session's .hdbrec.
replay.url URL: The environment; unless given, the recorded one if its file is beside FILE.

sweep.part WORDS: Instead of --tool: objects that move, all together.
sweep.path FILE: Poses, as for touch --poses.
sweep.about X,Y,Z/mm [middle of the tool's box]: the centre of the path's turns, tool's frame.
sweep.batch CSV: Many sweeps, one a line; see above.
sweep.seconds S [no limit]: Time of a sweep.
sweep.envelope NAME: Store all that the motion sweeps as an object of this name.
sweep.envelope_voxel LENGTH/mm [2 million in the path's box]: edge of its voxels.
sweep.replace: Replace an envelope of this name.
sweep.until_hit: End at the first hit on the path: faster.
sweep.cloud_radius LENGTH/mm [0]: radius of the points of clouds; with 0, nothing is between them.
sweep.gaps FILE: Write the gap of each near pair along the path to a new file: .csv, .parquet or
  .npz, or .svg, a plot.
sweep.within LENGTH/mm [50]: pairs so near are in --gaps.

reach.axis X,Y,Z [the target's axis of symmetry, from both ends]: Outward direction of the axis.
reach.approach [-z]: Direction in which the tool moves onto the target, tool's frame.
reach.about X,Y,Z/mm [its origin]: the tool's point on the target's end face, tool's frame.
reach.offset LENGTH/mm [0]: so far outward of the end face.
reach.lift LENGTH/mm [20]: way of the tool onto the target, and off it.
reach.turn ANGLE [60]: Degrees, or such as 1.05rad: turn on the target, by the right-hand rule.
reach.step ANGLE [15]: Degrees, or such as 0.1rad: from one placement to the next.
reach.seconds S [no limit]: Time of all targets.

clashes.within LENGTH/mm [1]: pairs that are so near are told.
clashes.contact LENGTH/mm [0.05]: surfaces so near, or so little one in the other, touch.
clashes.of WORDS: One of each pair.
clashes.against WORDS: The other one of each pair.
clashes.kind KIND [all are told; overlapping, duplicate, too near and inside give exit code 1]:
  Kinds that are told, and that exit code 1 stands for.
clashes.seconds S [no limit]: Time of the search; the next call goes on.
clashes.budget SIZE [256MiB]: Memory for shapes, MiB or such as 4GiB.
clashes.accept A B: Accept the known pairs of these objects, with --because.
clashes.because TEXT: Why --accept accepts; '' takes it back.
clashes.rules TOML: Rules of the database from now on, instead of its own.
clashes.rule TEXT: One more: 'bolts/* in *: overlap up to 0.3 mm is meant because ...'.
clashes.group ID: Pairs of one group; with --because, accept them.
clashes.all: A table of pairs, not of groups.
clashes.least_volume VOLUME [none is computed]: Cubic centimetres, or such as 5mm3: volumes of
  overlaps, without smaller ones.
clashes.html FILE: Write a page with pictures, a matrix and the table to a new file.
clashes.junit FILE: Write findings and rules as JUnit test cases, for CI.
clashes.bcf FILE: Write findings as topics of BCF 2.1 with GlobalIds of IFC, such as hall.bcfzip.
clashes.poses FILE: Displacements of --of, metres, as for touch --poses: say when it meets what.
clashes.turn AXIS: Instead: turn --of about x, y or z, as on a hinge.
clashes.about X,Y,Z/mm [middle of --of]: a point of the hinge, or the centre of turns, scene's
  frame.
clashes.from DEG: Degrees: start of --turn.
clashes.to DEG: Degrees: end of --turn.

distance.a A: An object, by id or name, or several, such as 'wheel*'.
distance.b B: Another one, or several.

extract.disassemble: Take off what blocks the parts first, step by step.
extract.depth N [3]: Most objects that wait for one another, beside the parts.
extract.keep WORDS: Objects that are never taken off.
extract.seconds S [60; 600 with --disassemble]: Time of the search.
extract.seed N: Seed of the search.
extract.motions N: Motions that the planner tries; 0: straight pulls only.
extract.out LENGTH/mm [clear of all that stands]: so far from its start the part counts as out.
extract.to POSE: Reach this displacement instead: x,y,z,qw,qx,qy,qz, millimetres, or such as
  0,5,0.2in,1,0,0,0; or a CSV file of one pose, metres.
extract.screw LENGTH/mm: the pitch of a thread, of either hand, a turn.
extract.path CSV: Write the path that was found.
extract.animation HTML: Write a page of the parts on their paths, in one file (pip install viser).
extract.up [the files']: Axis that points up in the animation.

move.translate X,Y,Z/m: shift from the present place, world frame.
move.matrix NUMBERS: New placement: 16 numbers, row by row, separated by commas or blanks.

copy.source SRC: The environment to copy.
copy.target DST: Made when it does not exist; of any engine.
copy.layout [that of SRC]: Index table of a new environment.
copy.curve [that of SRC]: Order of the keys of a new environment.
diff.a A: An environment.
diff.b B: Another one; of any engine.
check.repair: Then make wrong rows and boxes anew, from surfaces; remove stray rows; have 'clashes'
  measure wrong pairs again.
backup.file FILE: The copy: an SQLite file.
backup.replace: Replace an environment that exists, with its log.
grant.role ROLE: A role of the server.
grant.as: What ROLE may do from now on, instead of what it may do now.

sample.folder DIR: Made when it does not exist.
demo.bits 1..21: Bits of each axis of the grid.
demo.frames N: Poses of the path; the sample's has 1,000.
demo.points N: Points of the tool.
"""
"""Texts by name, or by verb and name: ``name VALUE [default]: help``. VALUE is absent from flags
and choices. A length is read in the unit after its slash unless it has its own; its verb gets
metres."""
SIZES: dict[str | None, Callable[[str], object]] = {
    "VOLUME": volume_of, "SIZE": size_of, "ANGLE": angle_of
}  # fmt: skip
"""Parsers by placeholders."""
_ALSO = {"serve": "view", "sample": "demo", "demo": "sample"}
"""Verbs with the texts of another verb as well."""
_ENTRY = re.compile(r"^([a-z_.]+)(?: ([^\[\n]+?))?(?: \[([^]]*)\])?:\s((?:.|\n  )*)", re.MULTILINE)


_TEXTS = {
    name: (value or None, default or None, " ".join(words.split()))
    for name, value, default, words in _ENTRY.findall(TEXTS)
}
"""Placeholder of the value, default and words of each entry of `TEXTS`."""


def command(verb: Callable[..., None]) -> Callable[..., None]:
    """Verb in typer's form: parameters with their texts, dataclasses flattened to their fields."""
    parameters = signature(verb).parameters
    groups = {
        name: tuple(signature(one.annotation).parameters.values())
        for name, one in parameters.items()
        if isinstance(one.annotation, type) and is_dataclass(one.annotation)
    }
    name = verb.__name__.rstrip("_")

    @wraps(verb)
    def called(**given: Any) -> None:  # noqa: ANN401 - of all kinds
        for group, members in groups.items():
            values = {one.name: given.pop(one.name) for one in members}
            given[group] = parameters[group].annotation(**values)
        verb(**given)

    flat = [
        _documented(name, member, is_option=one.kind is Parameter.KEYWORD_ONLY)
        for group, one in parameters.items()
        for member in groups.get(group, (one,))
    ]
    called.__signature__ = Signature(flat)  # type: ignore[attr-defined]
    return called


def _documented(verb: str, parameter: Parameter, *, is_option: bool) -> Parameter:
    """Parameter with typer's annotation: flags, metavar, help, parser."""
    name = parameter.name.rstrip("_")
    keys = (f"{verb}.{name}", f"{_ALSO.get(verb)}.{name}", name)
    value, default, words = next(_TEXTS[key] for key in keys if key in _TEXTS)
    parser = None
    if value and "/" in value[1:] and value.rpartition("/")[2] in NAMES:
        value, _, unit = value.rpartition("/")
        parse, such = (length_of, "0.2in") if value == "LENGTH" else (point_of, "0,5,0.2in")
        words = f"{NAMES[unit].capitalize()}, or such as {such}: {words}"
        parser = _unless_read(partial(parse, unit=unit))
    elif value in SIZES:
        parser = _unless_read(SIZES[value])
    elif value and value.startswith("WORDS"):
        words = f"{words[:-1]}: 7 or 3,4, 'wheel*', attribute=value."
    if is_option and str(parameter.annotation).startswith("list"):
        words += " Give it again for more."
    if not is_option:
        info = typer.Argument(metavar=value, help=words)
    else:
        flag = f"--{name.replace('_', '-')}"
        is_either = parameter.annotation == bool | None
        flags = f"{flag}/--no-{name}" if is_either else flag
        info = typer.Option(
            flags, metavar=value, help=words, show_default=default or True, parser=parser
        )
    return parameter.replace(
        kind=Parameter.KEYWORD_ONLY, annotation=Annotated[parameter.annotation, info]
    )


def _unless_read(parse: Callable[[str], object]) -> Callable[[object], object]:
    """Parser of texts; returns a default, parsed before, unchanged."""
    return lambda given: parse(given) if isinstance(given, str) else given
