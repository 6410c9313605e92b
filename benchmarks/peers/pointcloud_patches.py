"""pgpointcloud with PostGIS on PostgreSQL 15: voxels as points in patches, a patch a brick.

A frame asks by one statement for the patches whose box meets the box around the tool's voxels, in
three dimensions through PostGIS's GiST index, and takes the points out of them in the client.
Measured on the sample at 11 bits: built and indexed in 10 s, 113 MB, 1.4 ms a frame. The same
bricks as PostGIS's own MultiPointZ: 10 s, 505 MB, 2.0 ms. Both fetch more than is asked for, and
are still far ahead of a descent of the index for each point, decided in the server: 22 ms.
"""

import shutil
import struct
import tempfile
from pathlib import Path

import numpy as np
import psycopg

from hapticdb.kernels import curves
from hapticdb.store.base import NO_OCCUPANCY, Keys
from hapticdb.store.postgres.private_server import PrivateServer
from peers import PeerMissingError, PeerWork
from peers.rows import Found, RowPeer

SETTINGS = {"shared_buffers": "1GB", "max_wal_size": "4GB", "maintenance_work_mem": "256MB"}
INSTALL = "not measured: apt-get install postgresql-15-postgis-3 postgresql-15-pointcloud"
EXTENSIONS = ("postgis", "pointcloud", "pointcloud_postgis")
AXIS = """<pc:dimension><pc:position>{n}</pc:position><pc:size>2</pc:size><pc:name>{name}</pc:name>
<pc:interpretation>uint16_t</pc:interpretation><pc:scale>1</pc:scale></pc:dimension>"""
AXES = "".join(AXIS.format(n=n, name=name) for n, name in enumerate("XYZ", start=1))
FORMAT = f"""<pc:PointCloudSchema xmlns:pc="http://pointcloud.org/schemas/PC/1.1">{AXES}
<pc:metadata><Metadata name="compression">none</Metadata></pc:metadata></pc:PointCloudSchema>"""
BOX = "PC_BoundingDiagonalGeometry(points)"
NEAR = f"""
SELECT points FROM patch WHERE {BOX} &&& ST_MakeLine(
  ST_MakePoint(%s::float8, %s::float8, %s::float8),
  ST_MakePoint(%s::float8, %s::float8, %s::float8))"""
HEAD = struct.Struct("<BIII")
"""Of a patch: little endian, format, compression, count of points."""
POINT_BYTES = 6


class PointcloudPatches(RowPeer):
    """Voxels in patches, found by their boxes."""

    name = "pgpointcloud"
    layout = "voxel"

    def load(self, work: PeerWork) -> None:
        if work.binaries is None:
            raise PeerMissingError(INSTALL)
        # a short path that the server's account may enter
        folder = Path(tempfile.mkdtemp(prefix="hapticdb-peer-"))
        self._server = PrivateServer.at(folder, work.binaries, SETTINGS)
        try:
            self._server.start()
            self._connection = psycopg.connect(self._server.conninfo(), autocommit=True)
            self._fill(work)
        except BaseException:  # Ctrl-C, too: no server and no folder is left behind
            self._server.stop()
            shutil.rmtree(folder)
            raise

    def _fill(self, work: PeerWork) -> None:
        execute = self._connection.execute
        found = execute("SELECT name FROM pg_available_extensions").fetchall()
        if not set(EXTENSIONS) <= {name for (name,) in found}:
            raise PeerMissingError(INSTALL)
        for name in EXTENSIONS:
            execute(f"CREATE EXTENSION {name}")
        execute("INSERT INTO pointcloud_formats (pcid, srid, schema) VALUES (1, 0, %s)", [FORMAT])
        execute("CREATE TABLE patch (points pcpatch(1))")
        counts = np.unpackbits(work.bricks.occupancy, axis=1).sum(axis=1).tolist()
        points = self.grid.decode(work.voxels).astype("<u2").tobytes()
        at = 0
        with self._connection.cursor().copy("COPY patch FROM STDIN") as copy:
            for count in counts:
                end = at + count * POINT_BYTES
                copy.write_row([(HEAD.pack(1, 1, 0, count) + points[at:end]).hex()])
                at = end
        execute(f"CREATE INDEX ON patch USING gist (({BOX}) gist_geometry_ops_nd)")
        execute("VACUUM ANALYZE patch")

    def look_up(self, keys: Keys) -> Found:
        voxels = curves.decode(keys, self.grid.bits, self.grid.curve_code)
        box = [*voxels.min(axis=0).tolist(), *voxels.max(axis=0).tolist()]
        patches = self._connection.execute(NEAR, box, prepare=True).fetchall()
        points = bytes.fromhex("".join([patch[2 * HEAD.size :] for (patch,) in patches]))
        near = np.frombuffer(points, "<u2").reshape(-1, 3).astype(np.int64)
        near_keys = curves.encode(near, self.grid.bits, self.grid.curve_code)
        at = keys.searchsorted(near_keys)
        is_found = np.zeros(len(keys), dtype=np.bool_)
        is_found[at[keys.take(at, mode="clip") == near_keys]] = True
        return keys[is_found], NO_OCCUPANCY

    def size(self) -> tuple[str, int]:
        row = self._connection.execute("SELECT pg_total_relation_size('patch')").fetchone()
        assert row is not None
        return "file", int(row[0])

    def close(self) -> None:
        self._connection.close()
        self._server.stop()
        shutil.rmtree(self._server.folder)


PEERS = (PointcloudPatches,)
