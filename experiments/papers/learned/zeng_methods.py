"""Zeng et al. 2021, table 2: SVGF, NTASD with uniform samples, TRMV, and their own network, at one sample a pixel;
and the default of this library's clips.

Their PSNR has a peak of 255 on images in [0, 1]; the gaps below do not depend on it. Each network is trained by the
loss of its own paper: NTASD without the occlusion loss, which is theirs.
"""

from experiments.papers.learned.scores import Claim, Table, ordinary, psnr_gain
from jaxdn.evaluation.report import Results

THEIRS, NTASD = "ntd, 1 sample", "ntasd, uniform, 1 sample"
GAPS = {"svgf": 10.48, NTASD: 2.42, "trmv": 1.76}
"""Decibels of their network above each."""
ROWS = (*GAPS, THEIRS, "steady-balanced")
"""Those of the paper's table, and the default of this library's clips, whose weights are shipped."""


def text(found: Results) -> str:
    """The table."""
    return ordinary(found, ROWS)


def claims(found: Results) -> list[Claim]:
    """On how far the network is ahead of each; at least half as far as in the paper is taken as the same finding."""
    ours = {name: psnr_gain(found, THEIRS, name) for name in GAPS}
    return [
        Claim(f"ntd is better than {name}, PSNR", f"{there:.2f} dB", f"{ours[name]:+.2f} dB", ours[name] >= there / 2)
        for name, there in GAPS.items()
    ]


TABLE = Table("Zeng et al. 2021, table 2: methods", ROWS, text, claims, spp=1)
