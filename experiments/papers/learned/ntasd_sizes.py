"""Hasselgren et al. 2020, table 3: large and small networks; and the ladder from direct prediction to all kernels."""

from itertools import pairwise

from experiments.papers.learned.scores import Claim, Table, ordinary, psnr_gain
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

SMALL, LARGE = "ntasd, uniform", "ntasd, uniform, large"
LADDER = ("ntasd, direct", "ntasd, one scale", "ntasd, three scales", "ntasd")
"""Each adds to the one before: a kernel, kernels at two coarser scales, one for the image of the previous frame."""
ROWS = (SMALL, LARGE, *LADDER)


def text(found: Results) -> str:
    """The sizes with the time of a frame, and the ladder."""
    means = mean_scores(found)
    lines = ["| size | PSNR | temporal PSNR | milliseconds of a frame of the test clips |", "|---|---|---|---|"]
    for label in (SMALL, LARGE):
        one = means[label]
        lines.append(
            f"| {label} | {one.unbiased_psnr:.2f} | {one.unbiased_temporal_psnr:.2f} | {one.ms_per_frame:.0f} |"
        )
    return "\n".join(lines) + f"\n\n{ordinary(found, LADDER)}"


def claims(found: Results) -> list[Claim]:
    """On what size and kernels are worth."""
    means = mean_scores(found)
    slower = means[LARGE].ms_per_frame / means[SMALL].ms_per_frame
    worth = psnr_gain(found, LARGE, SMALL)
    steps = [psnr_gain(found, after, before) for before, after in pairwise(LADDER)]
    temporal = means["ntasd"].unbiased_temporal_psnr - means["ntasd, three scales"].unbiased_temporal_psnr
    return [
        Claim("the large network is better, PSNR", "0.6 dB", f"{worth:+.2f} dB", worth > 0),
        Claim("and slower", "3.0 times", f"{slower:.1f} times", slower > 1),
        Claim("a kernel in place of colours, PSNR", "above 0", f"{steps[0]:+.2f} dB", steps[0] > 0),
        Claim("three scales in place of one, PSNR", "above 0", f"{steps[1]:+.2f} dB", steps[1] > 0),
        Claim("a kernel for the previous image, temporal PSNR", "above 0", f"{temporal:+.2f} dB", temporal > 0),
    ]


TABLE = Table("Hasselgren et al. 2020, table 3: sizes, and the ladder of kernels", ROWS, text, claims)
