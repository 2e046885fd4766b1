"""Zeng et al. 2021, and what each change of ours is worth on top of the paper's settings, alone and together.

At one sample a pixel. The paper's loss and options; but without ``--as-published`` at ten times its rate, at which a
few hundred updates train a network.
"""

from experiments.papers.learned.scores import NOT_STATED, Claim, Table, error_ratio, ordinary, psnr_gain
from experiments.papers.learned.stages import CHANGES, stage_of_changes
from jaxdn.evaluation.report import Results

BASE, ALL = stage_of_changes(()), stage_of_changes(tuple(CHANGES))
ROWS = (BASE, *(stage_of_changes((change,)) for change in CHANGES), ALL)


def text(found: Results) -> str:
    """The errors of all rows, and their distances from the first."""
    lines = ["| change | PSNR | relative MSE |", "|---|---|---|"]
    lines += [
        f"| {row} | {psnr_gain(found, row, BASE):+.2f} dB | {error_ratio(found, row, BASE):.2f} times |"
        for row in ROWS[1:]
    ]
    return f"{ordinary(found, ROWS)}\n\n" + "\n".join(lines)


def claims(found: Results) -> list[Claim]:
    """What each change is worth, of which the paper says nothing."""
    gains = {row: psnr_gain(found, row, BASE) for row in ROWS[1:]}
    return [Claim(f"{row}, PSNR", NOT_STATED, f"{gain:+.2f} dB") for row, gain in gains.items()]


TABLE = Table("Zeng et al. 2021, and what our changes are worth", ROWS, text, claims, spp=1)
