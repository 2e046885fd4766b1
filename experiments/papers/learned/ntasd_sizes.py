"""Hasselgren et al. 2020, table 3 and figure 7: large and small networks, and the ladder from single frames upwards."""

from itertools import pairwise

from experiments.papers.learned.scores import Claim, Table, is_gain, ordinary, psnr_gain
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

SMALL, LARGE = "ntasd", "ntasd, large"
UNIFORM_SMALL, UNIFORM_LARGE = "ntasd, uniform", "ntasd, uniform, large"
LADDER = ("single frames, direct", "single frames, three scales", UNIFORM_SMALL, SMALL)
"""Each adds to the one before: kernels at three scales, the last image, samples where they pay. All but the last have
as many samples everywhere."""
ROWS = (SMALL, LARGE, UNIFORM_SMALL, UNIFORM_LARGE, *LADDER[:2])
DENOISER_MS, KERNELS_MS = {SMALL: 10, LARGE: 21}, {SMALL: 1, LARGE: 1}
"""Of a frame, in the paper: a network with the same number of samples everywhere has no sampler (3 and 20 ms)."""


def text(found: Results) -> str:
    """The sizes with the time of a frame, and the ladder."""
    means = mean_scores(found)
    lines = ["| size | PSNR | temporal PSNR | milliseconds of a frame of the test clips |", "|---|---|---|---|"]
    for label in ROWS[:4]:
        one = means[label]
        lines.append(
            f"| {label} | {one.unbiased_psnr:.2f} | {one.unbiased_temporal_psnr:.2f} | {one.ms_per_frame:.0f} |"
        )
    return "\n".join(lines) + f"\n\n{ordinary(found, LADDER)}"


def claims(found: Results) -> list[Claim]:
    """On what size, kernels, the last image and the placing of samples are worth; half the paper's distance counts."""
    means = mean_scores(found)
    slower = means[UNIFORM_LARGE].ms_per_frame / means[UNIFORM_SMALL].ms_per_frame
    there = (DENOISER_MS[LARGE] + KERNELS_MS[LARGE]) / (DENOISER_MS[SMALL] + KERNELS_MS[SMALL])
    worth = psnr_gain(found, LARGE, SMALL)
    steps = [psnr_gain(found, after, before) for before, after in pairwise(LADDER)]
    temporal = means[LADDER[2]].unbiased_temporal_psnr - means[LADDER[1]].unbiased_temporal_psnr
    return [
        Claim("the large network is better, PSNR", "0.6 dB", f"{worth:+.2f} dB", worth >= 0.3),
        Claim("and slower, without samplers", f"{there:.1f} times", f"{slower:.1f} times", slower >= (1 + there) / 2),
        Claim("kernels in place of colours, single frames, PSNR", "above 0", f"{steps[0]:+.2f} dB", is_gain(steps[0])),
        Claim("the last image, PSNR", "above 0", f"{steps[1]:+.2f} dB", is_gain(steps[1])),
        Claim("the last image, temporal PSNR", "above 0", f"{temporal:+.2f} dB", is_gain(temporal)),
        Claim("samples where they pay, PSNR", "above 0", f"{steps[2]:+.2f} dB", is_gain(steps[2])),
    ]


TABLE = Table("Hasselgren et al. 2020, table 3 and figure 7: sizes, and the ladder", ROWS, text, claims)
