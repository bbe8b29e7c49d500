"""A primal-dual interior-point method for transcriptions, in fixed shapes: one program a mesh.

Newton's method on the perturbed first-order conditions, with inertia correction (`direction`); a
barrier that falls monotonically while the solution is far and follows a probing step when it is
near (`barrier`); a filter line search with second-order correction (`filter`, `line_search`); and
feasibility restoration by least-distance Newton steps (`transition`). One loop body serves every
kind of step, so that the factorisation is compiled once (`loop`).

**Source:** Waechter & Biegler, Mathematical Programming 106 (2006); Nocedal, Waechter & Waltz, SIAM
J. Optim. 19 (2009), for the adaptive barrier.
"""

from jaxguide.nominal.direct.interior_point.loop import begun as begun
from jaxguide.nominal.direct.interior_point.loop import ended as ended
from jaxguide.nominal.direct.interior_point.loop import iterated as iterated
from jaxguide.nominal.direct.interior_point.loop import minimise as minimise
from jaxguide.nominal.direct.interior_point.state import CONVERGED as CONVERGED
from jaxguide.nominal.direct.interior_point.state import INFEASIBLE as INFEASIBLE
from jaxguide.nominal.direct.interior_point.state import RUNNING as RUNNING
from jaxguide.nominal.direct.interior_point.state import STALLED as STALLED
from jaxguide.nominal.direct.interior_point.state import TOO_MANY as TOO_MANY
from jaxguide.nominal.direct.interior_point.state import Options as Options
from jaxguide.nominal.direct.interior_point.state import Solution as Solution
from jaxguide.nominal.direct.interior_point.state import Start as Start
