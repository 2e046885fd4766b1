"""Hasselgren et al. 2020, table 3 and figure 7: large and small networks, and the ladder from single frames upwards.

Beside them what they tried and left out: 64 numbers a pixel that the network keeps for itself (sec. 3.2).
"""

from itertools import pairwise

from experiments.papers.learned.scores import NOT_STATED, Claim, Table, is_gain, ordinary, psnr_gain
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

SMALL, LARGE, TENTH = "ntasd", "ntasd, large", "ntasd, tenth"
"""The one of a tenth of RAE's weights is the small one of the paper; what is called small here has a fifth."""
UNIFORM_SMALL, UNIFORM_LARGE = "ntasd, uniform", "ntasd, uniform, large"
FEATURES = "ntasd, uniform, 64 features"
RAE = "rae"
LADDER = ("single frames, direct", "single frames, three scales", UNIFORM_SMALL, SMALL)
"""Each adds to the one before: kernels at three scales, the last image, samples where they pay. All but the last have
as many samples everywhere."""
SIZES = (TENTH, SMALL, LARGE, UNIFORM_SMALL, UNIFORM_LARGE)
ROWS = (*SIZES, *LADDER[:2], FEATURES, RAE)
MS = {TENTH: 3 + 10 + 1, LARGE: 20 + 21 + 1}
"""Sampler, denoiser and kernels of a frame, in the paper."""


def text(found: Results) -> str:
    """The sizes with the time of a frame, and the ladder with what stands beside it."""
    means = mean_scores(found)
    lines = ["| size | PSNR | temporal PSNR | milliseconds of a frame of the test clips |", "|---|---|---|---|"]
    for label in SIZES:
        one = means[label]
        lines.append(
            f"| {label} | {one.unbiased_psnr:.2f} | {one.unbiased_temporal_psnr:.2f} | {one.ms_per_frame:.0f} |"
        )
    return "\n".join(lines) + f"\n\n{ordinary(found, (*LADDER, FEATURES, RAE))}"


def claims(found: Results) -> list[Claim]:
    """On what size, kernels, the last image and the placing of samples are worth.

    What is half to twice the paper's distance counts as found: far more says that a network has failed.
    """
    means = mean_scores(found)
    slower = means[LARGE].ms_per_frame / means[TENTH].ms_per_frame
    there = MS[LARGE] / MS[TENTH]
    worth = psnr_gain(found, LARGE, TENTH)
    over_rae = psnr_gain(found, TENTH, RAE)
    features = psnr_gain(found, FEATURES, UNIFORM_SMALL)
    steps = [psnr_gain(found, after, before) for before, after in pairwise(LADDER)]
    temporal = means[LADDER[2]].unbiased_temporal_psnr - means[LADDER[1]].unbiased_temporal_psnr
    return [
        Claim(
            "the large network is better than a tenth of RAE's weights",
            "0.6 dB",
            f"{worth:+.2f} dB",
            0.3 <= worth <= 1.2,
        ),
        Claim("and slower", f"{there:.1f} times", f"{slower:.1f} times", slower >= (1 + there) / 2),
        Claim("a tenth of RAE's weights are better than RAE, PSNR", NOT_STATED, f"{over_rae:+.2f} dB"),
        Claim("kernels in place of colours, single frames, PSNR", "above 0", f"{steps[0]:+.2f} dB", is_gain(steps[0])),
        Claim("the last image, PSNR", "above 0", f"{steps[1]:+.2f} dB", is_gain(steps[1])),
        Claim("the last image, temporal PSNR", "above 0", f"{temporal:+.2f} dB", is_gain(temporal)),
        Claim("samples where they pay, PSNR", "above 0", f"{steps[2]:+.2f} dB", is_gain(steps[2])),
        Claim("64 features that recur, PSNR", "-0.2 dB", f"{features:+.2f} dB", is_gain(-features)),
    ]


TABLE = Table("Hasselgren et al. 2020, table 3 and figure 7: sizes, and the ladder", ROWS, text, claims)
