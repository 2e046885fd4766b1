"""README and docs: their links lead somewhere, their commands parse, their code runs, their pictures are small."""

import importlib.util
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro
from PIL import Image

import jaxdn
from docs.figures import before_after, cycles_page, front_page, vectors
from jaxdn.clips import write_clip
from jaxdn.commands.arguments import COMMANDS, Denoise
from jaxdn.methods.registry import methods
from jaxdn.zoo.ready import AUTO, DEFAULT_MODEL, choose_model
from tests.experiments.test_cycles_score import write_clip_of_cycles
from tests.training.test_training import make_clip

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING")]
PAGES += sorted((ROOT / "docs").rglob("*.md"))


def pytest_id(path):
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=pytest_id)
def test_links_to_files_lead_to_files(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    missing = [link for link in targets if "://" not in link and not (page.parent / link).exists()]
    assert missing == []


def _anchors(page: Path) -> set[str]:
    """Of its headings, as MkDocs and GitHub make them: words in lower case, joined by hyphens."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.S), flags=re.M)
    plain = (re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", heading).strip()) for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=pytest_id)
def test_links_to_headings_lead_to_headings(page):
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    links = re.findall(r"\]\(([^)#\s:]*)#([^)\s]+)\)", text)
    pages = [(page.parent / path if path else page, anchor) for path, anchor in links]
    generated = ROOT / "docs" / "reference"  # its headings follow from the code; MkDocs checks them
    missing = [anchor for path, anchor in pages if path.resolve().parent != generated and anchor not in _anchors(path)]
    assert missing == []


@pytest.mark.parametrize("page", PAGES, ids=pytest_id)
def test_commands_parse(page):
    blocks = re.findall(r"```(?:text)?\n(.*?)```", page.read_text(), flags=re.S)
    lines = [line.strip() for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    for line in lines:
        if line.startswith("jaxdn ") and "|" not in line:
            tyro.cli(COMMANDS, args=shlex.split(line, comments=True)[1:])


@pytest.mark.parametrize("page", PAGES, ids=pytest_id)
def test_every_table_has_a_head(page):
    """An empty line ends a table: rows below it would be shown as text."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.S)
    tables = re.findall(r"(?:^\|.*\n)+", text, flags=re.M)
    assert [table for table in tables if not re.match(r".*\n\|[ :|-]+\n", table)] == []


def test_the_readmes_commands_read_what_earlier_ones_wrote():
    """Typed one after the other; ``make train`` writes data/demo."""
    made: set[str] = set()
    for block in re.findall(r"```\w*\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.S):
        for line in block.replace("\\\n", " ").splitlines():
            made |= {"data/demo"} if line.startswith("make train") else set()
            made |= (written := set(re.findall(r" -o (data/\S+)", line)))
            read = set(re.findall(r"data/[\w/-]+", line)) - written
            assert not {path for path in read if not path.startswith(tuple(made))}, line


@pytest.mark.parametrize("name", sorted(methods()))
def test_every_method_has_a_page_with_the_same_headings(name):
    page = (ROOT / "docs" / "concepts" / "methods" / f"{name}.md").read_text()
    headings = ["What it does", "Inputs", "Cost", "Where it fails", "Paper"]
    assert re.findall(r"^#+ (.*)$", page, flags=re.M) == [name, *headings]


def test_every_page_is_in_the_navigation():
    navigation = set(re.findall(r"^ +- .*: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), flags=re.M))
    assert navigation == {str(page.relative_to(ROOT / "docs")) for page in (ROOT / "docs").rglob("*.md")}


def test_every_package_and_module_is_in_the_reference():
    pages = [page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md")]
    named = {name for page in pages for name in re.findall(r"^<!-- api: (jaxdn\.\w+) -->$", page, flags=re.M)}
    there = {path.relative_to(ROOT).with_suffix("").parts for path in (ROOT / "jaxdn").rglob("*.py")}
    public = {f"jaxdn.{parts[1]}" for parts in there if not parts[1].startswith("_")}
    assert named == public - {"jaxdn.clips"}  # another name of jaxdn.data.clip


def test_the_reference_lists_every_public_name():
    table = (ROOT / "docs" / "reference" / "core.md").read_text().partition("<!--")[0]
    assert {name for name in jaxdn.__all__ if f"`{name}`" not in table} == {"__version__"}


def test_the_reference_pages_follow_from_the_code():
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    assert spec is not None
    assert spec.loader is not None
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    pages = {page.stem: hooks.on_page_markdown(page.read_text()) for page in (ROOT / "docs" / "reference").glob("*.md")}
    assert not [name for name, text in pages.items() if "<!--" in text]
    assert "::: jaxdn.ops.warp\n" in pages["operations"]
    assert "| `radiance` | 3 | light |" in pages["formats"]
    assert "| `sigma_normal` | a number >= 0 | `16.0` |" in pages["options"]
    assert "--max-memory" in pages["command-line"]
    assert hooks.on_page_content("see :func:<code>jaxdn.warp</code>").count('<autoref identifier="jaxdn.warp"') == 1
    with pytest.raises(ValueError, match=r"expected a module or package of jaxdn, got jaxdn\.nothing"):
        hooks.on_page_markdown("<!-- api: jaxdn.nothing -->")


def test_the_pictures_are_small():
    sizes = {path.name: path.stat().st_size for path in (ROOT / "docs" / "images").iterdir()}
    assert sizes
    assert max(sizes.values()) < 300_000
    assert sum(sizes.values()) < 1_500_000


def test_the_default_of_denoise_on_our_clips_is_what_reports_open_on():
    assert Denoise.__dataclass_fields__["method"].default == AUTO
    assert choose_model(through_centres=True).name == DEFAULT_MODEL


def test_the_tutorials_denoiser_runs_and_learns(tmp_path, monkeypatch, capsys):
    write_clip(make_clip(0, frames=8), tmp_path / "data" / "demo" / "test" / "robot-200")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "how-to" / "own-denoiser.md").read_text()
    found: dict[str, object] = {}
    exec("\n".join(re.findall(r"```python\n(.*?)```", page, re.S)), found)
    assert "dB, running mean" in capsys.readouterr().out
    assert float(found["noisy"]) < float(found["before"])
    assert float(found["before"]) < float(found["after"])


def test_the_pictures_of_motion_vectors_are_drawn(tmp_path, capsys):
    clip = make_clip(1, frames=3)
    frames = clip.frames._replace(motion=np.full_like(clip.frames.motion, 2.0), visible=np.zeros((3, 16, 16, 1), bool))
    folder = tmp_path / "clip"
    write_clip(clip._replace(frames=frames), folder)
    vectors.main(vectors.Settings(folder, 1, out=tmp_path))
    for name in ("motion.webp", "dual-motion.webp"):
        with Image.open(tmp_path / name) as picture:
            assert np.asarray(picture).std() > 10
    with pytest.raises(ValueError, match="frame before it, 1 to 2"):
        vectors.main(vectors.Settings(folder, 0, out=tmp_path))
    write_clip(clip._replace(frames=frames._replace(visible=None)), tmp_path / "other")
    with pytest.raises(ValueError, match="expected a clip with visible"):
        vectors.main(vectors.Settings(tmp_path / "other", 1, out=tmp_path))


@pytest.mark.slow
def test_a_frame_of_cycles_stands_beside_what_methods_make_of_it(tmp_path):
    write_clip_of_cycles(tmp_path / "sun-9000", np.random.default_rng(4))
    out = tmp_path / "cycles.webp"
    cycles_page.main(cycles_page.Settings(tmp_path / "sun-9000", (0, 0, 24, 16), 2, 4, ("svgf+no-safe",), out))
    with Image.open(out) as picture:
        shown = np.asarray(picture, np.float64)
    assert shown.shape == (
        front_page._LABEL + 32 + front_page._GAP + 32,
        3 * (48 + front_page._GAP) - front_page._GAP,
        3,
    )
    noisy, denoised, reference = (shown[front_page._LABEL :][:32, left : left + 48] for left in (0, 52, 104))
    assert np.abs(denoised - reference).mean() < 0.5 * np.abs(noisy - reference).mean()


def test_frames_stand_side_by_side_with_a_part_enlarged(tmp_path):
    pictures = {"a": np.zeros((18, 32, 3)), "b": np.full((18, 32, 3), 0.5)}
    pictures["a"][4:6, 8:10] = 1.0
    whole = np.asarray(front_page.sheet(pictures, (8, 4, 2, 2)))
    assert whole.shape == (front_page._LABEL + 18 + front_page._GAP + 32, 2 * 32 + front_page._GAP, 3)
    assert (whole[-30:, :32] == 255).all()  # the enlarged part of the first
    assert (whole[-30:, -32:] == 128).all()
    assert front_page.sheet(pictures, None).height == front_page._LABEL + 18
    for seed, name in enumerate(("before", "after")):
        write_clip(make_clip(seed), tmp_path / name)
    settings = before_after.Settings(tmp_path / "before", tmp_path / "after", 1, out=tmp_path / "x.webp")
    before_after.main(settings)
    assert (tmp_path / "x.webp").stat().st_size > 100
