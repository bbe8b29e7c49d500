"""Figures of extremals, gains, flights, sweeps and tuning. Host only; no display is needed, as
pyplot is not used.

Each `plot_` function returns a `matplotlib.figure.Figure`; `save` writes it to a file. Every line
has a dash pattern of its own beside its colour, so that figures can be read in black and white.
Everywhere `units` maps names of states and controls, and "t", to the units shown on the axes.
"""

from jaxguide.plotting.style import COLOURS as COLOURS
from jaxguide.plotting.style import MARKERS as MARKERS
from jaxguide.plotting.style import STYLE as STYLE
from jaxguide.plotting.style import WIDTH as WIDTH
from jaxguide.plotting.style import label as label
from jaxguide.plotting.style import line as line
from jaxguide.plotting.style import save as save
from jaxguide.plotting.style import styled as styled
from jaxguide.plotting.style import symbol as symbol
from jaxguide.plotting.sweeps import align as align
from jaxguide.plotting.sweeps import ellipse as ellipse
from jaxguide.plotting.sweeps import plot_sweep as plot_sweep
from jaxguide.plotting.trajectories import at as at
from jaxguide.plotting.trajectories import plot_deviations as plot_deviations
from jaxguide.plotting.trajectories import plot_extremal as plot_extremal
from jaxguide.plotting.trajectories import plot_flight as plot_flight
from jaxguide.plotting.trajectories import plot_gain_errors as plot_gain_errors
from jaxguide.plotting.trajectories import plot_gains as plot_gains
from jaxguide.plotting.trajectories import plot_reoptimised as plot_reoptimised
from jaxguide.plotting.tuning import plot_tuning as plot_tuning
