"""The structure: imports point down, the core needs only jax and numpy, public names are where they should be."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import jaxdn

PACKAGE = Path(jaxdn.__file__).parent

MATHS = (
    "checks",
    "extras",
    "options",
    "frame",
    "repair",
    "denoiser",
    "numerics",
    "stencils",
    "color",
    "motion",
    "scales",
    "ops",
    "heap",
    "brdf",
    "microfacets",
    "glints",
)
LAYERS = {
    **dict.fromkeys(("platform", "compiled"), 0),
    **dict.fromkeys((*MATHS, "ops", "losses", "metrics", "flip", "sampling", "objectives", "recipe", "variation"), 1),
    **dict.fromkeys(("shrinkage", "whole"), 1),
    **dict.fromkeys(("filters", "networks"), 2),
    **dict.fromkeys(("methods", "denoisers"), 3),
    **dict.fromkeys(("rollout", "parts", "additive", "learning", "planning"), 4),
    **dict.fromkeys(("files", "render", "clips", "checkpoint", "report", "weights", "candidates", "export"), 5),
    "effects": 6,
    **dict.fromkeys(("cli", "arguments", "commands"), 7),
}
OUTSIDE = {
    "flax": {"networks"},
    "numba": {"compiled"},
    "optax": {"learning"},
    "mitsuba": {"render"},
    "drjit": {"render"},
    "OpenEXR": {"clips"},
    "grain": {"clips"},
    "orbax": {"checkpoint"},
    "matplotlib": {"report"},
    "PIL": {"report"},
    "safetensors": {"weights"},
    "tyro": {"cli", "arguments"},
}


def _imports(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{name.name}" for name in node.names}
    return found


def _imported_by_name(path: Path) -> list[ast.expr]:
    """The arguments of all calls of ``import_module``."""
    calls = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    names = ((getattr(call.func, "attr", getattr(call.func, "id", "")), call) for call in calls)
    return [call.args[0] for name, call in names if name == "import_module"]


def _package(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if path != PACKAGE / "__init__.py"]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    layer = LAYERS[_package(path)]
    for name in _imports(path):
        top, _, rest = name.partition(".")
        if top == "jaxdn":
            package = rest.partition(".")[0]
            if package in LAYERS:
                assert LAYERS[package] <= layer, f"{path} (layer {layer}) imports {name} (layer {LAYERS[package]})"
        elif top in OUTSIDE:
            assert _package(path) in OUTSIDE[top], f"{path} imports {top}"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_packages_import_by_name_only_from_themselves(path):
    """An import without an import statement would bypass the test above."""
    for argument in _imported_by_name(path):
        written = ast.unparse(argument)
        package = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts[:2])
        own = written.startswith(("__package__", "f'{__package__}", f"f'{package}.", f"'{package}."))
        outside = isinstance(argument, ast.Constant) and not str(argument.value).startswith("jaxdn")
        assert own or outside, f"{path} imports {written}; write an import statement"


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_a_module_is_short_and_has_a_docstring(path):
    assert len(path.read_text().splitlines()) <= 450
    assert ast.get_docstring(ast.parse(path.read_text())), "the first line says what the module is"


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
