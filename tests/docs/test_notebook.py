"""The notebooks run from top to bottom in a real kernel; their asserts check their claims."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "notebooks"
PRINTED = {
    "pieces": ("error in the disoccluded strip, dual", "PSNR: noisy"),
    "microfacets": ("ggx: alpha", "Fresnel term: largest error", "alpha depends most"),
    "glints": ("of a binomial count", "correlation with the first frame", "flakes in a texel"),
}


def test_every_notebook_is_run():
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == set(PRINTED)


@pytest.mark.slow
@pytest.mark.usefixtures("plain_processes")
@pytest.mark.parametrize("name", PRINTED)
def test_a_notebook_runs(name):
    notebook = nbformat.read(FOLDER / f"{name}.ipynb", as_version=4)
    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
    printed = "".join(
        output.get("text", "") for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs
    )
    for expected in PRINTED[name]:
        assert expected in printed
