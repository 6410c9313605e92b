"""Trilinear interpolation in a resident cell, with the 8 corners in vector registers.

The arithmetic is that of `lattice.trilinear`, bit for bit. With 8 single-byte loads, a frame of
100,000 contacts takes a tenth longer.
"""

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

from hapticdb.kernels.field.lattice import CELL_SIDE, STEPS, trilinear

FIRST_OF_PAIRS = (0, CELL_SIDE, CELL_SIDE * CELL_SIDE, CELL_SIDE * (CELL_SIDE + 1))
"""Offsets of the corners with the lower k from the lowest corner."""

if config.DISABLE_JIT:

    def interpolated(payload, at, x, y, z):
        """Trilinear value, in steps, as of the intrinsic below."""
        values = payload.reshape(-1)
        corners = [values[int(at) + first + k] for first in FIRST_OF_PAIRS for k in (0, 1)]
        return trilinear(*np.minimum(corners, STEPS).astype(np.int64), x, y, z)

    def fetch_corners(payload, at):
        """Prefetch: nothing without the JIT."""

else:

    def _shuffled(builder, one, other, places):
        """Vector of the elements at some places of two vectors."""
        kind = ir.VectorType(ir.IntType(32), len(places))
        return builder.shuffle_vector(one, other, ir.Constant(kind, list(places)))

    def _between(builder, low, high, share):
        """Linear interpolation of two vectors: low + share (high - low)."""
        count = low.type.count
        nothing = ir.Constant(low.type, ir.Undefined)
        first = builder.insert_element(nothing, share, ir.Constant(ir.IntType(32), 0))
        shares = _shuffled(builder, first, nothing, [0] * count)
        return builder.fadd(low, builder.fmul(shares, builder.fsub(high, low)))

    def _corners(builder, data, at):
        """The 8 corners, at most STEPS, as doubles: those with the lower k, then the others."""
        pair, eight = ir.VectorType(ir.IntType(8), 2), ir.VectorType(ir.IntType(8), 8)
        pairs = []
        for first in FIRST_OF_PAIRS:
            where = builder.gep(data, [builder.add(at, ir.Constant(at.type, first))])
            # one load for both k; align 1, since a pair may begin at any byte
            pairs.append(builder.load(builder.bitcast(where, pair.as_pointer()), align=1))
        front = _shuffled(builder, pairs[0], pairs[1], range(4))
        back = _shuffled(builder, pairs[2], pairs[3], range(4))
        # k apart: the first interpolation then runs on two vectors of four
        steps = _shuffled(builder, front, back, (0, 2, 4, 6, 1, 3, 5, 7))
        most = ir.Constant(eight, [STEPS] * 8)
        steps = builder.select(builder.icmp_unsigned("<", steps, most), steps, most)
        halves = []
        for places in (range(4), range(4, 8)):
            half = _shuffled(builder, steps, steps, places)
            half = builder.zext(half, ir.VectorType(ir.IntType(32), 4))
            halves.append(builder.sitofp(half, ir.VectorType(ir.DoubleType(), 4)))
        return halves

    @intrinsic
    def interpolated(typing_context, payload, at, x, y, z):  # noqa: ARG001 - numba's signature
        """Trilinear value, in steps, of the 8 corners from index `at` of payload (S, 34^3) on.

        at : uint64, unchecked; x, y, z : 0 to 1 from the lowest corner. BEYOND counts as STEPS.
        """
        real = types.float64

        def generate(context, builder, signature, arguments):
            payload, at, x, y, z = arguments
            data = context.make_array(signature.args[0])(context, builder, payload).data
            low, high = _corners(builder, data, at)
            values = _between(builder, low, high, z)
            low, high = (_shuffled(builder, values, values, places) for places in ((0, 2), (1, 3)))
            values = _between(builder, low, high, y)
            low, high = (
                builder.extract_element(values, ir.Constant(ir.IntType(32), n)) for n in (0, 1)
            )
            return builder.fadd(low, builder.fmul(x, builder.fsub(high, low)))

        return real(payload, types.uint64, real, real, real), generate

    @intrinsic
    def fetch_corners(typing_context, payload, at):  # noqa: ARG001 - numba's signature
        """Prefetch the corners of `interpolated` into the processor's cache."""

        def generate(context, builder, signature, arguments):
            payload, at = arguments
            data = context.make_array(signature.args[0])(context, builder, payload).data
            byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
            kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
            fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], fnty=kind)
            for first in FIRST_OF_PAIRS:
                where = builder.gep(data, [builder.add(at, ir.Constant(at.type, first))])
                # read access, highest locality, data cache
                hints = [ir.Constant(number, hint) for hint in (0, 3, 1)]
                builder.call(fetch, [builder.bitcast(where, byte), *hints])
            return context.get_dummy_value()

        return types.none(payload, types.uint64), generate
