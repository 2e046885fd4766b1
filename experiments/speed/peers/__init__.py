"""What people use today, each behind one small door: PyTorch (the same network) and Open Image Denoise.

They are optional. What is not installed is left out, and :func:`missing` says so in a sentence.
"""

import importlib.util
import platform
import shutil

_PACKAGES = {"torch": "PyTorch", "pyoidn": "Open Image Denoise (pyoidn)"}


def missing() -> dict[str, str]:
    """Peer -> why its rows are left out here, in a sentence; what can be run is not in it.

    Peers are ``"torch"``, ``"torch-compiled"`` and ``"pyoidn"``.
    """
    reasons = {
        package: f"{name} is not installed: `make bench` installs it; its rows are left out."
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
