"""The build hook of wheels: compiles the kernels, so that nobody waits for that later."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = "src/hapticdb/kernels/_machine"
CODE = """
import shutil
from hapticdb.kernels import _building, _machine_code, _sets
shutil.rmtree(_sets.SHIPPED, ignore_errors=True)
for group in _machine_code.GROUPS:
    own = _sets.own_set(group)
    if _machine_code.manifest_of(own).get("for") == _machine_code.built_for():
        shutil.copytree(own, _sets.SHIPPED / group)
    else:
        _building.build_set(_sets.SHIPPED / group, group)
for lock in _sets.SHIPPED.glob("*.lock"):
    lock.unlink()
"""


class KernelHook(BuildHookInterface):  # type: ignore[type-arg]
    """Puts the machine code of all kernels into a wheel, whose tag then names Python and system."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile all kernels; a wheel without them, and a line, where that cannot be done."""
        if self.target_name != "wheel" or version == "editable":
            return
        self.app.display_info("compiling kernels: about half a minute on two processors")
        source = str(Path(self.root, "src"))
        path = os.pathsep.join([source, *filter(None, [os.environ.get("PYTHONPATH")])])
        done = subprocess.run(  # noqa: S603 - this interpreter, this package
            [sys.executable, "-c", CODE], env=os.environ | {"PYTHONPATH": path}, check=False
        )
        if done.returncode:
            self.app.display_warning(
                "the wheel has no compiled kernels: the errors are above; they are compiled once "
                "on each machine that has the wheel installed"
            )
            return
        build_data["pure_python"] = False
        build_data["infer_tag"] = True
        build_data["artifacts"].append(f"{FOLDER}/**")
