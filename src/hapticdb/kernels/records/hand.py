"""Records of one hand: device, tool, coupling, frame."""

import numpy as np

from hapticdb.kernels.records.layout import Layout, record

RESULT: Layout = record(
    [
        ("wrench", "<f8", 6),  # about the tool's centre of mass, world frame: N, N m
        ("hits", "<f8"),  # points in a voxel or, with distances, near a surface
        ("contacts", "<f8"),  # points below their tangent plane or the onset
        ("unknown", "<f8"),  # points in unknown cells
        ("deepest", "<f8"),  # contact, m
    ]
)
"""Result of a frame."""

HAND: Layout = record(
    [
        ("position", "<f8", 3),  # m
        ("quaternion", "<f8", 4),  # unit, scalar first
        ("velocity", "<f8", 6),  # of the origin, m/s, then rad/s
        ("is_stale", "?"),  # all cells count as unknown
        ("is_open", "?"),  # the clutch
    ]
)
"""Handle, the target of the tool: its frame in the scene. NaN: no handle yet."""

HANDLE: Layout = record(
    [
        ("scale", "<f8"),  # m of the scene for a metre of the device
        ("clutch", "<i8"),  # bit of its button, 0 for none
        ("starts_elsewhere", "?"),  # at `start`, not at the hand
        ("start", "<f8", 7),  # position m, unit quaternion
        ("is_placed", "?"),  # there was a reading
        ("x", "<f8"),  # of its last finite position, m
        # from hand to handle: added to the hand's position, applied before the hand's turn
        ("position", "<f8", 3),
        ("quaternion", "<f8", 4),
    ]
)
"""Transform from a device's readings to a handle (`kernels.hand.handle_motion`)."""

READING: Layout = record([("pose", "<f8", (4, 4)), ("velocity", "<f8", 6), ("buttons", "<i8")])
"""Reading of a device (`hapticdb.devices.protocol.Reading`)."""

TOOL: Layout = record(
    [
        ("position", "<f8", 3),  # of the tool's frame, m
        ("quaternion", "<f8", 4),  # unit, scalar first
        ("kept", "<f8", 6),  # last unfaded wrench for the hand: N, N m
        ("held_for", "<f8"),  # s since that wrench
        ("risen", "<f8"),  # share of the wrench sent, 0 to 1
        ("version", "<i8"),  # of the cells for `felt`, 0 for none
        ("felt", RESULT),  # frame at this pose
        ("pose", "<f8", (4, 4)),
        ("tried_pose", "<f8", (4, 4)),  # of the present query
    ]
)
"""Simulated tool. Initially all fields but position and quaternion are zero."""

SENT: Layout = record(
    [
        ("wrench", "<f8", 6),  # for the device, about the handle's origin: N, N m
        ("hits", "<i8"),
        ("contacts", "<i8"),
        ("unknown", "<i8"),  # points, at the tried pose
        ("deepest", "<f8"),  # m
        ("n_steps", "<i8"),
        ("marks", "<i8"),  # bits of `kernels.hand.fading`; `flags` is a name of NumPy's
        ("revision", "<i8"),  # of the database
    ]
)
"""Result of a period of the loop."""

SERVO: Layout = record([("tool", TOOL), ("hand", HAND), ("sent", SENT)])
"""State of a loop between periods."""

MOST_TRAIL = 64
"""Positions of the hand in the quasi-static coupling's history, for its damping. Larger: the same
time span at higher loop rates."""
FOLLOWER: Layout = record(
    [
        ("queried_at", "<f8", 7),  # pose of the tool for the near points
        ("travelled", "<f8"),  # path length of the farthest point, upper bound, voxels
        ("astray", "<f8"),  # voxels from the tool's pose to that of the last query
        ("clearance", "<f8"),  # least distance of points, lower bound, at the tool's pose, voxels
        ("tried_clearance", "<f8"),  # the same at the pose of the last query
        # the equations of a step (`kernels.hand.gauss_newton`)
        ("side", "<i8"),  # 0 or 1: half of the rows for the near points at the tool's pose
        ("n_near", "<i8"),  # near points at the tool's pose
        ("n_active", "<i8"),  # points in the contact set of the last step
        ("n_bends", "<i8"),  # rows of curvature in its equations
        ("is_bent", "?"),  # curvature of hollow surfaces is computed
        ("matrix", "<f8", (6, 6)),  # of the step's equations: N/m, N, N m
        ("right", "<f8", 6),  # their right-hand side: N, N m
        ("step", "<f8", 6),  # of the tool's centre: m, rad
        ("pull", "<f8", 6),  # from tool to hand: m, rad
        ("pulls", "<f8", 2),  # stiffnesses along it, lowered at the caps: N/m, N m/rad of the scene
        ("n_tried", "<i8"),  # near points at the pose of the last query, in the other half
        ("n_unknown", "<i8"),  # points in unknown cells there
        ("n_queries", "<i8"),  # queries in this period
        ("is_advancing", "?"),  # the pose of the query may be forbidden
        ("is_loose", "?"),  # the tool is inside an object, without contacts yet
        ("is_braked", "?"),  # the last step was shortened: the next one is braked
        ("last_hand", "<f8", 3),  # the handle's position in the last period, m
        ("trail", "<f8", (MOST_TRAIL, 4)),  # ring buffer: time s and position m of the handle
        ("n_trail", "<i8"),  # positions written since the handle was last lost
        ("clock", "<f8"),  # s
        ("share", "<f8"),  # of the stiffness in use, 0 to 1
        ("wanted_share", "<f8"),  # target of `share`, by the guard
        ("reversals", "<f8"),  # of the force, with exponential decay
        ("extreme", "<f8"),  # N, greatest or least force since the last reversal
        ("is_rising", "?"),  # the force, since then
        # of large tools
        ("is_large", "?"),  # set by the caller: a run's sphere is tested before its points
        ("merges_from", "<i8"),  # set by the caller: number of near points to merge at; 0: never
        ("merged", "<i8"),  # points for each contact; 0 counts as 1
        # of queries on a GPU
        ("gpu_query", "<i8"),  # address of the callback of a query; 0: on the CPU
        ("way", "<f8"),  # motion of the farthest point since the last query, voxels
        ("anew", "<i8"),  # reset before the next query: a code of `near_points`
    ]
)
"""State of the quasi-static coupling, in addition to the tool. Initially all zero."""

POINT: Layout = record(
    [
        ("due", "<f8"),  # path length (`travelled`), voxels, of the point's next query
        ("run_due", "<f8"),  # of point n: the least `due` of run number n
        ("u", "<f8"),  # distance at the tool's pose, voxels; h for a point not near
        ("bound", "<f8"),  # lower bound of it, likewise
        ("onset", "<f8"),  # distance at which its contact begins, voxels
    ]
)
"""State of the coupling for each point of the tool (`kernels.hand.near_points`)."""

NEAR: Layout = record(
    [
        ("point", "<i8"),  # its number
        ("is_active", "?"),  # it is in the contact set
        ("is_hollow", "?"),  # the surface bends towards it
        ("u", "<f8"),  # distance, voxels
        ("bound", "<f8"),  # lower bound of it, voxels
        ("along", "<f8", 3),  # gradient of the distance
        ("about", "<f8", 3),  # its moment about the tool's centre, m
    ]
)
"""Point near a surface. A step scans all near points, 80 bytes each. With the bends in the same
record, broad contacts take a tenth longer."""
BENDS: Layout = record(
    [
        ("curvature", "<f8", 2),  # 1/voxel, 0 for none
        ("along", "<f8", (2, 3)),  # unit directions
        ("about", "<f8", (2, 3)),  # their moments about the tool's centre, m
    ]
)
"""Principal curvatures of a hollow surface towards a near point, at most two."""

QUERY: Layout = record(
    [
        ("number", "<i8"),
        ("epoch", "<i8"),  # older values of points are invalid
        ("run", "<i8"),  # points of a run
        # as in FOLLOWER, for the tried pose
        ("is_large", "?"),
        ("is_anew", "?"),
        ("is_bent", "?"),
        ("merged", "<i8"),
        ("travelled", "<f8"),
        ("way", "<f8"),
        ("pose", "<f8", (3, 4)),
        # for `put_back` alone
        ("last", "<i8"),  # points beyond it are restored
        ("n_due", "<i8"),  # runs of its second launch
    ]
)
"""Parameters of a query on the GPU (`kernels.gpu.proximity_queries`)."""

FRAME: Layout = np.dtype(
    [
        ("time", "<f8"),  # s since the session's start, when the frame began
        ("dt", "<f8"),  # s since the frame before
        ("lateness", "<f4"),  # s behind its deadline
        ("elapsed", "<f4"),  # s of computing
        ("hand", "<f8", (7,)),  # the handle: position m, unit quaternion, scalar first
        ("hand_velocity", "<f8", (6,)),  # m/s, rad/s
        ("tool", "<f8", (7,)),  # the simulated body, likewise
        ("applied", "<f8", (6,)),  # sent to the device, about the handle's origin: N, N m
        ("spring", "<f8", (9,)),  # between hand and tool: `kernels.hand.device_spring`
        ("hits", "<i4"),
        ("contacts", "<i4"),
        ("unknown", "<i4"),  # points in cells not resident
        ("deepest", "<f4"),  # m
        ("revision", "<i8"),  # of the database
        ("buttons", "<i4"),  # bit mask
        ("state", "<i4"),  # bits of `hapticdb.recording.frame.State`
    ]
)
"""One frame of the loop, and a row of a recording: 336 bytes. Inputs: dt, hand, hand_velocity,
spring, and of the state the bits for a stale hand, an open clutch and new cells. Outputs: tool,
applied, hits, contacts, deepest and the other bits of the state."""
