"""Dispersed flights, pure and differentiable: distributions, sampling, rollouts, linear covariance.

`flags` lives in `jaxguide.host`; its documented old path, `jaxguide.montecarlo.flags`, stays.
"""

import sys

from jaxguide.host import flags as flags

sys.modules[f"{__name__}.flags"] = flags  # for `import jaxguide.montecarlo.flags`
