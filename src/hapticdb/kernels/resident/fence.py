"""Memory fence for memory shared by several processes without locks."""

from numba import config, types
from numba.extending import intrinsic

if config.DISABLE_JIT:

    def fence():
        """No operation: the interpreter never reorders loads and stores."""

else:

    @intrinsic
    def fence(typing_context):  # noqa: ARG001 - numba's signature
        """Sequentially consistent fence: loads and stores before it precede those after it."""

        def generate(context, builder, signature, arguments):  # noqa: ARG001
            builder.fence("seq_cst")
            return context.get_dummy_value()

        return types.none(), generate
