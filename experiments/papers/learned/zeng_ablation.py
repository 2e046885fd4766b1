"""Zeng et al. 2021, sec. 6.3: A, traditional vectors; B, dual vectors; C, dual vectors and the motion-occlusion loss.

At one sample a pixel, and nothing else differs. The paper shows pictures; its claim is that each is better where
something was hidden.
"""

from experiments.papers.learned.scores import Claim, Table, is_gain, ordinary
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

A, B, C = ROWS = ("ntd, traditional, without occlusion", "ntd, without occlusion", "ntd, 1 sample")


def text(found: Results) -> str:
    """The errors of all pixels, and of those that were hidden in the frame before."""
    means = mean_scores(found)
    lines = ["| | PSNR of disoccluded pixels |", "|---|---|"]
    lines += [f"| {row} | {means[row].disoccluded_psnr:.2f} |" for row in ROWS]
    return f"{ordinary(found, ROWS)}\n\n" + "\n".join(lines)


def claims(found: Results) -> list[Claim]:
    """On disoccluded pixels, step by step."""
    means = mean_scores(found)
    gains = {
        "dual vectors, disoccluded PSNR": means[B].disoccluded_psnr - means[A].disoccluded_psnr,
        "the motion-occlusion loss, disoccluded PSNR": means[C].disoccluded_psnr - means[B].disoccluded_psnr,
    }
    return [Claim(text, "above 0", f"{gain:+.2f} dB", is_gain(gain)) for text, gain in gains.items()]


TABLE = Table("Zeng et al. 2021, sec. 6.3: vectors and loss", ROWS, text, claims, spp=1)
