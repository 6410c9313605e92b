"""Files are read in a child process, as users read them."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _files_are_parsed_here() -> None:
    """Overrides the fixture of all other rooms."""
