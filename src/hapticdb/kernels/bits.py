"""Index of a word's lowest or highest set bit, in one processor instruction each."""

from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

if config.DISABLE_JIT:

    def lowest_bit(word):
        """Index of the lowest set bit of a word, an int64 above 0."""
        return (int(word) & -int(word)).bit_length() - 1

    def highest_bit(word):
        """Index of the highest set bit of a word, an int64 above 0."""
        return int(word).bit_length() - 1

else:

    def _counted(name, context, builder, word):
        """Trailing or leading zeros of a nonzero word, by an LLVM intrinsic."""
        kind = ir.FunctionType(word.type, [word.type, ir.IntType(1)])
        count = builder.module.declare_intrinsic(name, [word.type], fnty=kind)
        return builder.call(count, [word, context.get_constant(types.boolean, True)])

    @intrinsic
    def lowest_bit(typing_context, word):  # noqa: ARG001 - numba's signature
        """Index of the lowest set bit of a word, an int64 above 0."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            return _counted("llvm.cttz", context, builder, arguments[0])

        return types.int64(types.int64), generate

    @intrinsic
    def highest_bit(typing_context, word):  # noqa: ARG001 - likewise
        """Index of the highest set bit of a word, an int64 above 0."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            zeros = _counted("llvm.ctlz", context, builder, arguments[0])
            return builder.sub(ir.Constant(zeros.type, 63), zeros)

        return types.int64(types.int64), generate
