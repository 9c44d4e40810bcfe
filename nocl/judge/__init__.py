"""The judge: any controller, any plan, on the exact f under CVODES."""

from __future__ import annotations

from nocl.judge.laws import (
    answer_of,
    check_made_for,
    check_takes_p,
    dynamics_function,
    policy_function,
    takes_p,
)
from nocl.judge.runs import AT_BOUND, Simulation
from nocl.judge.simulation import simulate

__all__ = ["AT_BOUND", "Simulation", "answer_of", "check_made_for", "check_takes_p", "dynamics_function",
           "policy_function", "simulate", "takes_p"]
