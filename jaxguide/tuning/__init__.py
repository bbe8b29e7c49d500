"""Designs tuned by gradient through nominal, gains and flights: `jg.tune` and what it is fed."""

from jaxguide.tuning.counts import Count as Count
from jaxguide.tuning.counts import counted as counted
from jaxguide.tuning.counts import exhaustive as exhaustive
from jaxguide.tuning.designs import Ascending as Ascending
from jaxguide.tuning.designs import Bounded as Bounded
from jaxguide.tuning.designs import values as values
from jaxguide.tuning.flown import Flown as Flown
from jaxguide.tuning.loop import tune as tune
from jaxguide.tuning.measures import cost as cost
from jaxguide.tuning.measures import effort as effort
from jaxguide.tuning.measures import endpoint_miss as endpoint_miss
from jaxguide.tuning.measures import gain_evaluations as gain_evaluations
from jaxguide.tuning.ready import Ready as Ready
from jaxguide.tuning.record import Tuned as Tuned
from jaxguide.tuning.record import load_history as load_history
from jaxguide.tuning.relaxation import cooling as cooling
from jaxguide.tuning.relaxation import cutoff as cutoff
from jaxguide.tuning.relaxation import sample_lengths as sample_lengths
from jaxguide.tuning.relaxation import thinned_weights as thinned_weights
from jaxguide.tuning.risk import above as above
from jaxguide.tuning.risk import cvar as cvar
from jaxguide.tuning.risk import quantile as quantile
from jaxguide.tuning.risk import smooth_quantile as smooth_quantile
