"""Hasselgren et al. 2020, table 2: what a network loses on scenes of a kind that it was not trained on."""

import numpy as np

from experiments.papers.learned.scores import Claim, Table
from experiments.papers.learned.stages import HELD_OUT
from jaxdn.evaluation.report import Results

SEEN = "ntasd, uniform"
ROWS = (SEEN, *(f"{SEEN}, without {family}" for family in HELD_OUT))


def losses(found: Results) -> dict[str, tuple[float, float]]:
    """Family -> mean PSNR on its test clips of the network that was trained on the family, and of that without."""
    pairs = {}
    for family in HELD_OUT:
        own = [clip.scores for clip in found.clips if clip.name.startswith(f"{family}-")]
        seen, unseen = (
            float(np.mean([scores[label].unbiased_psnr for scores in own]))
            for label in (SEEN, f"{SEEN}, without {family}")
        )
        pairs[family] = (seen, unseen)
    return pairs


def text(found: Results) -> str:
    """One line a family."""
    lines = ["| family | PSNR, trained with it | without it | loss |", "|---|---|---|---|"]
    for family, (seen, unseen) in losses(found).items():
        lines.append(f"| {family} | {seen:.2f} | {unseen:.2f} | {seen - unseen:.2f} |")
    return "\n".join(lines)


def claims(found: Results) -> list[Claim]:
    """On the size of the losses: the two networks are nearly equal."""
    found_losses = [seen - unseen for seen, unseen in losses(found).values()]
    ours = f"{min(found_losses):.2f} to {max(found_losses):.2f} dB"
    return [Claim("the loss from leaving a scene out is small", "0.1 to 0.7 dB", ours, max(found_losses) <= 0.7)]


TABLE = Table("Hasselgren et al. 2020, table 2: specialised and held out", ROWS, text, claims)
