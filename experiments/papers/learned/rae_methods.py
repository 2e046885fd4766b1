"""SVGF, A-SVGF, RAE and A-RAE (Chaitanya et al. 2017; Schied et al. 2017, 2018), each with and without adaptive
accumulation. Both autoencoders are trained by the loss of Chaitanya et al.
"""

from experiments.papers.learned.scores import Claim, Table, is_gain, ordinary, over_frames, psnr_gain
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

RAE, ARAE = "rae, its own loss", "arae, its own loss"
ROWS = ("svgf", "asvgf", RAE, ARAE)


def text(found: Results) -> str:
    """The table, and how errors change over the frames."""
    return f"{ordinary(found, ROWS)}\n\n{over_frames(found, ROWS)}"


def claims(found: Results) -> list[Claim]:
    """On adaptive accumulation. No number of the papers is known to us."""
    means, found_claims = mean_scores(found), []
    for first, second in ((ARAE, RAE), ("asvgf", "svgf")):
        better = psnr_gain(found, first, second)
        steadier = means[first].unbiased_temporal_psnr - means[second].unbiased_temporal_psnr
        ours = f"{better:+.2f} dB, temporal {steadier:+.2f} dB"
        found_claims.append(Claim(f"{first} is better than {second}, PSNR", "above 0", ours, is_gain(better)))
    return found_claims


TABLE = Table("SVGF, A-SVGF, RAE and A-RAE", ROWS, text, claims)
