"""The alternatives in common use, one module each: PyTorch (the same network) and Open Image Denoise.

They are optional. Those not installed are left out, with a message from :func:`missing`.
"""

import importlib.util
import platform
import shutil

_PACKAGES = {"torch": "PyTorch", "pyoidn": "Open Image Denoise (pyoidn)"}


_MAKES = {"torch": "make bench", "pyoidn": "make setup"}
"""Package -> the target that installs it."""


def missing() -> dict[str, str]:
    """Peer -> a sentence why its rows are left out here; only peers that cannot be run.

    Peers are ``"torch"``, ``"torch-compiled"`` and ``"pyoidn"``.
    """
    reasons = {
        package: f"{name} is not installed: `{_MAKES[package]}` installs it; its rows are left out."
        for package, name in _PACKAGES.items()
        if importlib.util.find_spec(package) is None
    }
    if "torch" in reasons:
        reasons["torch-compiled"] = reasons["torch"]
    elif platform.system() == "Linux" and shutil.which("g++") is None:
        reasons["torch-compiled"] = (
            "torch.compile needs a C++ compiler (g++), which is not on the path; its rows are left out."
        )
    return reasons
