"""What a mutant is."""

from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


class Edit(NamedTuple):
    """A text that occurs once in a file, and what takes its place."""

    file: str
    """Relative to the root of the repository."""
    old: str
    new: str

    def applied(self, root: Path = ROOT) -> str:
        """The whole file after the edit. Raises ValueError where the text does not occur exactly once."""
        text = (root / self.file).read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(
                f"{self.file}: expected the text of a mutant once, got it {text.count(self.old)} times: {self.old!r}. "
                "Where the code has changed, its mutant in tests/mutants has to follow."
            )
        return text.replace(self.old, self.new)


class Mutant(NamedTuple):
    """A change of the code that is a mistake."""

    name: str
    edits: tuple[Edit, ...]
    tests: tuple[str, ...]
    """Names of tests as pytest takes them; at least one has to fail."""


def mutant(name: str, file: str, old: str, new: str, *tests: str) -> Mutant:
    """A mutant of one edit."""
    return Mutant(name, (Edit(file, old, new),), tests)
