"""How many examples hypothesis tries where a test does not give a number itself.

HYPOTHESIS_PROFILE=quick, the default, tries 25 of them; HYPOTHESIS_PROFILE=thorough tries 200.
"""

import os

import pytest
from hypothesis import settings

EXAMPLES = {"quick": 25, "thorough": 200}


def choose() -> None:
    """Load the profile that the environment names. To be called before test modules are imported.

    Examples have no deadline: the first one compiles kernels, and the machine may be busy.
    """
    for name, n_examples in EXAMPLES.items():
        settings.register_profile(name, max_examples=n_examples, deadline=None)
    wanted = os.environ.get("HYPOTHESIS_PROFILE", "quick")
    if wanted not in EXAMPLES:
        pytest.exit(f"HYPOTHESIS_PROFILE={wanted}: choose of {', '.join(EXAMPLES)}", 1)
    settings.load_profile(wanted)
