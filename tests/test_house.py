"""The structure: imports point down, the core needs only jax and numpy, public names are where they should be."""

import ast
import functools
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import jaxdn
from jaxdn import denoisers, render
from tests.house import PACKAGES, ROOMS, ROOT, with_table

PACKAGE = Path(jaxdn.__file__).parent


@functools.cache
def _parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(_parsed(path)):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return found


def _imported_by_name(path: Path) -> list[ast.expr]:
    """The arguments of all calls of ``import_module``."""
    calls = [node for node in ast.walk(_parsed(path)) if isinstance(node, ast.Call)]
    names = ((getattr(call.func, "attr", getattr(call.func, "id", "")), call) for call in calls)
    return [call.args[0] for name, call in names if name == "import_module"]


@functools.cache
def _room(module: str) -> str | None:
    """The room of ``a.b.c`` in jaxdn: itself, if it is on the map, else its folder; None for jaxdn itself."""
    if module in ROOMS or (PACKAGE / Path(*module.split("."))).is_dir():
        return module
    return module.rpartition(".")[0] or None


def _own(path: Path) -> str:
    relative = path.relative_to(PACKAGE).with_suffix("")
    return ".".join(relative.parts[:-1] if relative.name == "__init__" else relative.parts)


@functools.cache
def _imported(name: str) -> str:
    """The room that ``jaxdn.a.b.c``, a module or something in it, is imported from."""
    parts = name.split(".")[1:]
    while parts and not any((PACKAGE.joinpath(*parts)).with_suffix(end).exists() for end in ("", ".py")):
        parts.pop()
    return _room(".".join(parts)) or ""


OF_LOOPS = "ops.dispatch.loop_compilers"
"""Imports, in a process of its own, the modules of loops that the process which started it has imported."""
MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    room = _room(_own(path))
    assert room in ROOMS, f"{path}: its folder {room!r} is not on the map (tests/house.py)"
    for name in _imports(path):
        top = name.partition(".")[0]
        if top == "jaxdn":
            below = _imported(name)
            known = below in ("", room) or (below in ROOMS and ROOMS[below].floor < ROOMS[room].floor)
            assert known, f"{path} ({room}) imports {name} ({below}), which is not on a lower floor"
        elif top in PACKAGES:
            allowed = PACKAGES[top]
            assert any(room == each or room.startswith(f"{each}.") for each in allowed), f"{path} imports {top}"


def test_every_room_of_the_map_exists():
    for name in ROOMS:
        place = PACKAGE.joinpath(*name.split("."))
        assert place.is_dir() or place.with_suffix(".py").is_file(), name


def test_contributing_has_the_map():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    assert text == with_table(text), "run python -m tests.house"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_packages_import_by_name_only_from_themselves(path):
    """An import without an import statement would bypass the test above."""
    if _own(path) == OF_LOOPS:
        return
    for argument in _imported_by_name(path):
        written = ast.unparse(argument)
        package = ".".join(path.parent.relative_to(PACKAGE.parent).parts)
        own = written.startswith(("__package__", "f'{__package__}", f"f'{package}.", f"'{package}."))
        outside = isinstance(argument, ast.Constant) and not str(argument.value).startswith("jaxdn")
        assert own or outside, f"{path} imports {written}; write an import statement"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_is_short_and_has_a_docstring(path):
    assert len(path.read_text().splitlines()) <= 450
    assert ast.get_docstring(_parsed(path)), "the first line says what the module is"


ONLY_JAX = """
import importlib.abc, importlib.metadata, sys
ALLOWED = {"jax", "jaxlib", "numpy", "ml_dtypes", "opt_einsum", "scipy", "jaxdn"}
INSTALLED = set(importlib.metadata.packages_distributions()) - ALLOWED
class NothingElse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        # jax itself tries optional packages and copes without them
        if name.partition(".")[0] in INSTALLED:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, NothingElse())
import jax.numpy as jnp
import jaxdn
image = jnp.ones((8, 8, 3))
motion = jnp.zeros((8, 8, 2))
jaxdn.warp(image, jaxdn.dual_motion(motion, motion))
jaxdn.apply_kernels(image, jaxdn.normalize_kernels(jnp.zeros((8, 8, 25))))
jaxdn.compose_scales(image, image[::2, ::2], jnp.ones((4, 4, 1)))
jaxdn.metrics.psnr(image, 0.5 * image), jaxdn.losses.spatial(image[None], image[None])
svgf = jaxdn.denoisers.svgf()
clip = jaxdn.Clip(jaxdn.Frame(radiance=image[None]))
assert jaxdn.denoise(svgf, {}, clip).shape == (1, 8, 8, 3)
print("alone")
"""


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
def test_the_maths_needs_only_jax_and_numpy():
    done = subprocess.run([sys.executable, "-c", ONLY_JAX], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "alone", done.stderr


def test_importing_the_package_loads_nothing():
    code = "import jaxdn, sys; print(sorted(m for m in sys.modules if m.split('.')[0] in ('jax', 'numpy', 'mitsuba')))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", [name for name in jaxdn.__all__ if name != "__version__"])
def test_public_names_exist_and_have_docstrings(name):
    assert inspect.getdoc(getattr(jaxdn, name))


def test_an_unknown_name_says_which_there_are():
    with pytest.raises(AttributeError, match="warp"):
        jaxdn.wrap  # noqa: B018


FIXED = {
    "warp": ("image", "motion", "border", "implementation"),
    "dual_motion": ("motion", "forward_motion", "visible"),
    "occlusion_mask": ("motion", "dual_motion", "threshold"),
    "normalize_kernels": ("logits",),
    "apply_kernels": ("image", "kernels", "implementation"),
    "compose_scales": ("fine", "coarse", "alpha", "down", "up"),
    "denoise": ("denoiser", "params", "clip"),
}


@pytest.mark.parametrize(("name", "parameters"), FIXED.items())
def test_fixed_signatures(name, parameters):
    assert tuple(inspect.signature(getattr(jaxdn, name)).parameters) == parameters


def test_no_module_takes_the_place_of_a_public_function():
    # Importing jaxdn.warp, were there such a module, would bind it over the function of that name.
    rooms = {path.stem for path in PACKAGE.iterdir()}
    assert not rooms & (set(jaxdn.__all__) - {"brdf", "color", "losses", "metrics", "denoisers", "effects"})


def test_a_method_is_a_function_in_denoisers_and_a_module_in_methods():
    code = """
import importlib, types
import jaxdn.methods.ntd as module
from jaxdn.denoisers import ntd
import jaxdn.methods.ntd
assert isinstance(module, types.ModuleType) and isinstance(ntd, types.FunctionType)
assert jaxdn.denoisers.ntd is ntd
try:
    import jaxdn.denoisers.ntd as m
except ModuleNotFoundError:
    print("no such module")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "no such module", done.stderr


def _names_for_type_checkers(path: Path) -> set[str]:
    """Names that a module imports where only type checkers look."""
    blocks = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.If)]
    checked = [node for node in blocks if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"]
    imports = [each for block in checked for each in block.body if isinstance(each, ast.ImportFrom)]
    return {name.asname for each in imports for name in each.names if name.asname}


def test_type_checkers_see_all_public_names():
    assert _names_for_type_checkers(PACKAGE / "__init__.py") == set(jaxdn.__all__) - {"__version__"}
    assert _names_for_type_checkers(PACKAGE / "denoisers.py") == set(denoisers.NAMES)
    assert _names_for_type_checkers(PACKAGE / "render" / "__init__.py") == set(render.__all__)
