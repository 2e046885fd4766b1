"""Words in the names of files and folders that say which pass is in them: ``albedo``, ``DiffuseAlbedo``, ``mist``."""

import re
from collections.abc import Sequence

from jaxdn.data.foreign.layers import LAYERS, plain

BEAUTY = [name for name in LAYERS["radiance"] if name]
"""Words in the names of files that hold the picture, the best first."""
WEAK = {"main", "hdr", "image"}
"""Words for the picture that are names of shots, too: any word for data is stronger."""
UNREAD = "no buffer"
"""In place of a buffer: data that no denoiser reads."""
_UNREAD_WORDS = [
    "position",
    "world_position",
    "pworld",
    "pref",
    "p",
    "uv",
    "uvmap",
    "st",
    "mist",
    "alpha",
    "mask",
    "matte",
    "tangent",
    "material_id",
    "material_index",
    "indexma",
    "facing_ratio",
    "cryptomatte",
    "crypto_object",
    "crypto_material",
    "crypto_asset",
    "sample_count",
    "variance",
    "holdout",
]
PASSES: dict[str, str] = {
    **dict.fromkeys(_UNREAD_WORDS, UNREAD),
    # "sh_normal" is Mitsuba's name for a layer, and in names of files the normal of the shot "sh".
    **{name: buffer for buffer, names in LAYERS.items() for name in names if name not in ("", "sh_normal")},
    **dict.fromkeys(BEAUTY, "radiance"),
}
"""Word -> buffer."""


def split_words(text: str) -> list[str]:
    """The words of a name, and signs that part no words, such as the ``#`` of a number."""
    return re.findall(r"[^\W_]+|[^\w\s.-]+", text)


def join_words(tokens: Sequence[str]) -> str:
    return " ".join(tokens).lower()


_WORDS: dict[str, str] = {plain("".join(split_words(word))): word for word in PASSES}
"""Word without what parts its own words -> as it is: ``DiffuseAlbedo`` is ``diffuse_albedo``."""


def find_word(tokens: Sequence[str]) -> tuple[str, str] | None:
    """The longest word for a pass in a name, and the rest."""
    best, highest = None, (False, 0, 0)
    for start in range(len(tokens)):
        for end in range(start + 1, len(tokens) + 1):
            word = _WORDS.get(plain("".join(tokens[start:end])), "")
            score = word not in WEAK, len(word), end - start
            if word and score > highest:
                best, highest = (word, join_words([*tokens[:start], *tokens[end:]])), score
    return best


def pass_of_folder(name: str) -> str | None:
    """The word for the pass that a folder is called after; None if its name is any other."""
    return _WORDS.get(plain("".join(split_words(name))))


def are_pass_folders(names: Sequence[str]) -> bool:
    """Whether folders of these names have a file for each pass in them: a picture's is there, and another pass's."""
    buffers = {PASSES[word] for name in names if (word := pass_of_folder(name)) is not None}
    return "radiance" in buffers and len(buffers) > 1
