"""Ross & Karpenko, "A Review of Pseudospectral Optimal Control: From Theory to Flight" (Annual
Reviews in Control 36, 2012), sections 3 and 4: their statements on grids, weights, covectors and
rates, computed.
"""

import contextlib
from pathlib import Path

from jaxguide.host.progress import NoProgress, Progress
from jaxguide.reproduce.ps_review import sections
from jaxguide.reproduce.report import Report
from jaxguide.reproduce.stages import Stages


def run(out: Path | None = None, progress: Progress | None = None) -> Report:
    """Every claim of the two sections that has a number in it; figures 4, 5, 7, 8, 9 and two more
    go to the folder `out`, if given."""
    report = Report("Pseudospectral optimal control: a review (Ross & Karpenko 2012)")
    meter = NoProgress() if progress is None else progress
    stages = Stages(report, meter, len(sections.ALL) + (out is not None))
    with contextlib.closing(stages):
        for name, section in sections.ALL.items():
            with stages(name):
                section(report)
        if out is not None:
            from jaxguide.reproduce.ps_review.figures import write_figures

            with stages("figures"):
                report.figures = write_figures(out)
    return report
