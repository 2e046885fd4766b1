"""The packages that jaxdn needs have wheels for each Python and system that it names."""

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")


@pytest.mark.needs("uv with an index")
@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("system", ["linux", "windows", "macos"])
def test_wheels_of_the_pinned_versions_are_there(system: str, python: str) -> None:
    command = ["uv", "pip", "compile", "--quiet", "--no-annotate", "--no-header", "--no-emit-index-url"]
    command += ["--python-platform", system, "--python-version", python, "--only-binary", ":all:"]
    for extra in ("render", "train", "onnx", "oidn", "onednn", "farm"):
        command += ["--extra", extra]
    command += ["-c", "constraints.txt", "pyproject.toml"]
    environment = {**os.environ, "MACOSX_DEPLOYMENT_TARGET": "14.0"}  # ONNX Runtime asks for it
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    resolved = set(re.findall(r"^([\w-]+)==", done.stdout, flags=re.M))
    assert {"jax", "jaxlib", "numba", "flax", "openexr", "mitsuba", "grain", "onnxruntime"} <= resolved
    assert ("pyoidn" in resolved) == (system != "macos")
    assert ("onednn-cpu-gomp" in resolved) == (system == "linux")


def test_classifiers_name_these_pythons_and_systems() -> None:
    text = (ROOT / "pyproject.toml").read_text("utf-8")
    assert tuple(re.findall(r'"Programming Language :: Python :: (3\.\d+)"', text)) == PYTHONS
    assert len(re.findall(r'"Operating System :: ', text)) == 3
