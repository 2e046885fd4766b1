"""Hasselgren et al. 2020, table 2: networks of one scene, of all scenes, and of all but the one they are tested on."""

import numpy as np

from experiments.papers.learned.scores import Claim, Table
from experiments.papers.learned.stages import HELD_OUT
from jaxdn.evaluation.report import Results

SEEN = "ntasd, uniform"
KINDS = ("only", "without")
ROWS = (SEEN, *(f"{SEEN}, {kind} {family}" for kind in KINDS for family in HELD_OUT))


def figures(found: Results) -> list[dict[str, str | float]]:
    """One row a family: PSNR of the three networks, and what the held-out one loses to the specialised one."""
    columns = ("specialised", "trained on all", "held out")
    return [
        {"family": family, **dict(zip(columns, row, strict=True)), "loss": row[0] - row[2]}
        for family, row in scores(found).items()
    ]


def scores(found: Results) -> dict[str, tuple[float, float, float]]:
    """Family -> mean PSNR on its test clips of the networks trained on it alone, on all families, on all others."""
    rows = {}
    for family in HELD_OUT:
        own = [clip.scores for clip in found.clips if clip.name.startswith(f"{family}-")]
        special, seen, unseen = (
            float(np.mean([scores[label].unbiased_psnr for scores in own]))
            for label in (f"{SEEN}, only {family}", SEEN, f"{SEEN}, without {family}")
        )
        rows[family] = (special, seen, unseen)
    return rows


def text(found: Results) -> str:
    """One line a family."""
    lines = ["| family | PSNR, specialised | trained on all | held out | loss |", "|---|---|---|---|---|"]
    for family, (special, seen, unseen) in scores(found).items():
        lines.append(f"| {family} | {special:.2f} | {seen:.2f} | {unseen:.2f} | {special - unseen:.2f} |")
    return "\n".join(lines)


def claims(found: Results) -> list[Claim]:
    """On the size of the losses: specialised and held-out networks are nearly equal."""
    losses = [special - unseen for special, _, unseen in scores(found).values()]
    ours = f"{min(losses):.2f} to {max(losses):.2f} dB"
    return [Claim("a held-out network loses little to a specialised one", "0.1 to 0.7 dB", ours, max(losses) <= 0.7)]


TABLE = Table("Hasselgren et al. 2020, table 2: specialised and held out", ROWS, text, claims, figures=figures)
