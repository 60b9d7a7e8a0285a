"""`python -m tutorial_lib.plotting AGENT PNG` draws the README's picture."""

import sys

from tutorial_lib.plotting import robot_at_limits
from tutorial_lib.training import load_agent

robot_at_limits(load_agent(sys.argv[1])).savefig(sys.argv[2], dpi=80)
