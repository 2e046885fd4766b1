"""How much placing samples pays at each budget, from a quarter of a sample a pixel to four.

Hasselgren et al. 2020 report 0.66 to 0.75 of the relative MSE of uniform sampling, at four samples. Here networks are
trained and tested in rooms with a small lamp (:mod:`experiments.papers.learned.small_lights`). A network places half of
the budget; the numbers are rounded by a fixed pattern that rotates from frame to frame. It is compared with the same
number of samples everywhere, whose fractions are rounded at random or, for budgets below one, by that pattern. Each
network is trained with its own budget, from that of the next larger one: at equal budgets all have had as many updates,
at smaller budgets more.
"""

from typing import Any

from experiments.papers.learned.scores import NOT_STATED, Claim, Table, error_ratio, ordinary
from experiments.papers.learned.stages import BUDGETS, ROTATING, stage_of_budget
from jaxdn.evaluation.report import Results
from jaxdn.evaluation.report.results import mean_scores

CHOSEN, UNIFORM, PATTERN = "ntasd", "ntasd, uniform", "ntasd, rotating"
ROWS = tuple(
    stage_of_budget(kind, budget)
    for budget in BUDGETS
    for kind in (CHOSEN, UNIFORM, *((PATTERN,) if budget in ROTATING else ()))
)
PUBLISHED = 0.75
"""The largest of their three ratios."""
PUBLISHED_BUDGET = 4.0
"""Samples a pixel that these are of."""


def text(found: Results) -> str:
    """The errors of all rows, and their ratios by budget."""
    means = mean_scores(found)
    lines = [
        "| samples a pixel | chosen / uniform, relative MSE | chosen / rotating | chosen - uniform, PSNR | ms more |",
        "|---|---|---|---|---|",
    ]
    for budget in BUDGETS:
        chosen, uniform = (stage_of_budget(kind, budget) for kind in (CHOSEN, UNIFORM))
        rotating = (
            "" if budget not in ROTATING else f"{error_ratio(found, chosen, stage_of_budget(PATTERN, budget)):.2f}"
        )
        gain: Any = means[chosen].unbiased_psnr - means[uniform].unbiased_psnr
        more = means[chosen].ms_per_frame - means[uniform].ms_per_frame
        lines.append(
            f"| {budget:g} | {error_ratio(found, chosen, uniform):.2f} | {rotating} | {gain:+.2f} dB | {more:.1f} |"
        )
    return f"{ordinary(found, ROWS)}\n\n" + "\n".join(lines)


def claims(found: Results) -> list[Claim]:
    """The ratios and times of each budget; the paper has four samples alone."""
    means, made = mean_scores(found), []
    for budget in BUDGETS:
        chosen, uniform, rotating = (stage_of_budget(kind, budget) for kind in (CHOSEN, UNIFORM, PATTERN))
        count = f"{budget:g} sample{'s' * (budget != 1)}"
        pairs = {"chosen / uniform": (chosen, uniform)}
        if budget in ROTATING:
            pairs |= {"chosen / rotating": (chosen, rotating), "rotating / uniform": (rotating, uniform)}
        for text, pair in pairs.items():
            ratio = error_ratio(found, *pair)
            stated = text == "chosen / uniform" and budget == PUBLISHED_BUDGET
            there, holds = ("0.66 to 0.75", ratio <= PUBLISHED) if stated else (NOT_STATED, None)
            made.append(Claim(f"{text}, relative MSE, {count}", there, f"{ratio:.2f}", holds))
        more = means[chosen].ms_per_frame - means[uniform].ms_per_frame
        made.append(Claim(f"time of choosing, {count}", NOT_STATED, f"{more:.1f} ms a frame"))
    return made


TABLE = Table("Samples where they pay, by budget", ROWS, text, claims, budgets=True, clips="small lights")
