"""A memory fence for memory that several processes read and write without locks."""

from numba import config, types
from numba.extending import intrinsic

if config.DISABLE_JIT:

    def fence():
        """Do nothing: the interpreter never reorders loads and stores."""

else:

    @intrinsic
    def fence(typing_context):  # noqa: ARG001 - numba's signature
        """Every process sees the loads and stores before the fence before those after it."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            builder.fence("seq_cst")
            return context.get_dummy_value()

        return types.none(), generate
