"""A memory fence for what several processes read and write without locks."""

from numba import config, types
from numba.extending import intrinsic

if config.DISABLE_JIT:

    def fence():
        """Nothing: the interpreter moves no load or store past another."""

else:

    @intrinsic
    def fence(typing_context):  # noqa: ARG001 - numba's signature
        """Loads and stores before it are seen by all before those after it."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            builder.fence("seq_cst")
            return context.get_dummy_value()

        return types.none(), generate
