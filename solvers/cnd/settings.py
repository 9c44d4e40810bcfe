"""Settings of the default training method."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class TrainSettings:
    """The default method's settings."""

    intervals: int = 80  # RK4 steps and held controls of each labelled solution
    seeds: int = 20  # initial states solved globally, from cold starts
    starts: int = 16  # cold starts of each
    states: int = 400  # further initial states, solved from their neighbours
    tails: int = 3000  # optimal tails from the tube
    width: float = 0.25  # of the tube, in units of each state's spread along the solutions
    visits: int = 2000  # visited states solved in each round
    kick: float = 0.1  # pushes on the visiting policy, in units of each state's spread
    rounds: int = 3  # of visited states, at most
    least_rounds: int = 2  # and at least: the gap is met sooner than under disturbances
    iterations: int = 2000  # of each regression; twice as many from the round on that may be the last
    batch: int = 1024
    lr: float = 4e-3
    hidden: tuple[int, ...] = (64, 64, 64)
    control_dt: bool = False  # True: u(x, t, dt), optimal in continuous time and held for dt; see CND.at_rate
    value: bool = True  # whether to train V(x, t) too
    value_initial: int = 1500  # initial states solved for V, from the nearest solutions and the policy's own answers
    value_tails: int = 6000  # tails solved for it, from the tube
    value_visits: int = 3000  # more of them, from states that the policy visits under kicks
    value_iterations: int = 7000  # of the first fit of V; twice as many of further ones
    value_rounds: int = 3  # fits of V at most: each further one on as many labels more
    value_error: float = 2.5e-3  # stop once met: mean of |V - J*| / J* at held-out initial, tube and kicked states
    held_out: int = 64  # initial states that tell when to stop
    gap_median: float = 2e-4  # stop once both are met: (J - J*) / J*, median over the held-out states,
    gap_p95: float = 1e-3  # and its 95th percentile

    def __post_init__(self) -> None:
        for f in fields(self):
            value, least = getattr(self, f.name), 0 if f.name in ("rounds", "least_rounds", "states", "tails") else 1
            if f.type == "int" and (isinstance(value, bool) or not isinstance(value, int) or value < least):
                raise ValueError(f"TrainSettings: {f.name} is {value!r}; expected a whole number of at least {least}")
            if f.type == "float" and not (isinstance(value, (int, float)) and 0 < value < float("inf")):
                raise ValueError(f"TrainSettings: {f.name} is {value!r}; expected a positive number")
            if f.type == "bool" and not isinstance(value, bool):
                raise ValueError(f"TrainSettings: {f.name} is {value!r}; expected True or False")
        widths = self.hidden if isinstance(self.hidden, (tuple, list)) else ()
        if not widths or not all(isinstance(h, int) and not isinstance(h, bool) and h > 0 for h in widths):
            raise ValueError(f"TrainSettings: hidden is {self.hidden!r}; expected widths such as (64, 64, 64)")
