"""`python -m tutorial_lib.course.figures AGENT PNG` draws the README's picture."""

import sys

from tutorial_lib.checkpoints import load_agent
from tutorial_lib.course.figures import robot_at_limits

robot_at_limits(load_agent(sys.argv[1])).savefig(sys.argv[2], dpi=80)
