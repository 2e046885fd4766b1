"""Hasselgren et al. 2020, table 1: samples where they pay against uniform ones, DASR, and direct prediction.

The numbers of the paper are relative MSE at four samples of SunTemple, Classroom and Bathroom. All networks
are trained by one loss.
"""

from experiments.papers.learned.scores import Claim, Table, error_ratio, is_gain, ordinary, over_frames, psnr_gain
from experiments.papers.learned.stages import AFTERWARDS
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

ROWS = (
    "noisy",
    "svgf",
    "ntasd",
    "ntasd, uniform",
    "single frames, three scales",
    "single frames, direct",
    "dasr",
    "dasr, uniform",
    "rae",
    f"rae{AFTERWARDS}",
    f"ntasd{AFTERWARDS}",
)


def text(found: Results) -> str:
    """The table, and how errors change over the frames."""
    return f"{ordinary(found, ROWS)}\n\n{over_frames(found, ROWS)}"


def claims(found: Results) -> list[Claim]:
    """On relative MSE, and on steadiness; a ratio above 1 has to be at least half as far from it as in the paper."""
    adaptive = error_ratio(found, "ntasd", "ntasd, uniform")
    dasr = error_ratio(found, "dasr", "ntasd")
    direct = error_ratio(found, "single frames, direct", "single frames, three scales")
    means = mean_scores(found)
    steadier = means["ntasd"].unbiased_temporal_psnr - means["dasr"].unbiased_temporal_psnr
    smoothed = means[f"rae{AFTERWARDS}"].unbiased_temporal_psnr - means["rae"].unbiased_temporal_psnr
    return [
        Claim("adaptive / uniform sampling, relative MSE", "0.66 to 0.75", f"{adaptive:.2f}", adaptive <= 0.75),
        Claim("DASR / NTASD, relative MSE", "1.4 to 1.8", f"{dasr:.2f}", dasr >= 1.2),
        Claim(
            "direct prediction / kernels, single frames, relative MSE", "1.7 to 2.1", f"{direct:.2f}", direct >= 1.35
        ),
        Claim("NTASD is steadier than DASR, temporal PSNR", "above 0", f"{steadier:+.2f} dB", is_gain(steadier)),
        Claim("TAA makes RAE steadier, temporal PSNR", "above 0", f"{smoothed:+.2f} dB", is_gain(smoothed)),
        Claim(
            "NTASD is better than RAE, PSNR",
            "above 0",
            f"{psnr_gain(found, 'ntasd', 'rae'):+.2f} dB",
            is_gain(psnr_gain(found, "ntasd", "rae")),
        ),
    ]


TABLE = Table("Hasselgren et al. 2020, table 1: methods", ROWS, text, claims)
