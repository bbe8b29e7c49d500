"""What a user states: Problem P of the 2012 review, eq. (2)."""

from jaxguide.problem import told as told
from jaxguide.problem.boundary import initial_bounds as initial_bounds
from jaxguide.problem.boundary import initial_entries as initial_entries
from jaxguide.problem.boundary import initial_values as initial_values
from jaxguide.problem.boundary import initially_free as initially_free
from jaxguide.problem.boundary import is_endless as is_endless
from jaxguide.problem.boundary import start_control as start_control
from jaxguide.problem.counts import count as count
from jaxguide.problem.counts import endpoint_count as endpoint_count
from jaxguide.problem.parameters import Chosen as Chosen
from jaxguide.problem.parameters import Path as Path
from jaxguide.problem.parameters import choices as choices
from jaxguide.problem.parameters import parameters as parameters
from jaxguide.problem.parameters import replace_parameters as replace_parameters
from jaxguide.problem.parameters import with_parameters as with_parameters
from jaxguide.problem.statement import Free as Free
from jaxguide.problem.statement import Problem as Problem
from jaxguide.problem.statement import is_free as is_free
from jaxguide.problem.statement import start_value as start_value
from jaxguide.problem.statement import with_array_leaves as with_array_leaves
from jaxguide.problem.statement import with_typed_leaves as with_typed_leaves
from jaxguide.problem.validation import check_initial_state as check_initial_state
from jaxguide.problem.validation import validate as validate
