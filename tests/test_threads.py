"""Every public object that can be called, from several threads of Python at once: the answers of one thread."""

import threading
import warnings

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.exports.c_code import load
from nocl.nets import MLP, FeatureNet
from nocl.solvers import DDP, LQR, NMPC
from nocl.sysid.identification import LearnedDynamics

THREADS, CALLS, ROWS = 4, 3, 6


def ocp():
    return nocl.load_ocp("pendulum")


def cnd():
    return nocl.pretrained("pendulum")


def model():
    """A small network with fixed weights beside the exact f."""
    system = ocp().system
    x, u, y = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("y", 2)
    net = MLP([3, 8, 2]).double().eval()
    with torch.no_grad():
        for p in net.parameters():
            p.copy_(torch.linspace(-0.5, 0.5, p.numel(), dtype=torch.float64).reshape(p.shape))
    maps = ca.Function("phi", [x, u], [ca.vertcat(x, u)]), ca.Function("xdot", [x, u, y], [system.f(x, u) + 0.1 * y])
    return LearnedDynamics(system, FeatureNet(maps[0], [net], maps[1]), "random")


def rows_of(function, *more):
    """A casadi.Function as a call with rows x [B, 2]."""
    return lambda x: np.hstack([out.full() for out in function.call([x.T, *(ca.DM(m) for m in more)])])


def both_values(cnd):
    return lambda x: np.c_[cnd.value(x, 0.5), cnd.value_gradient(x, 0.5)]


def linearised(system):
    return lambda x: np.hstack([np.hstack(system.linearize(row, [0.3])) for row in x])


def of_torch(function):
    return lambda x: torch.as_tensor(function(torch.from_numpy(x), torch.full((len(x), 1), 0.3, dtype=torch.float64)))


def compiled(folder):
    """The controller in C: built once, loaded by each."""
    if not (folder / "pendulum_policy.c").exists():
        cnd().to_c(folder)
    policy = load(folder, "pendulum_policy")
    return lambda x: np.array([policy(row, 0.5) for row in x])


U = np.full((1, ROWS), 0.3)
OBJECTS = {
    "NMPC": lambda _: lambda x: NMPC(ocp(), 15, starts=1, passes=0).solve(x[:2], workers=1).u,
    "DDP": lambda _: DDP(ocp(), intervals=30, threads=1).solve,
    "DDP, two threads": lambda _: DDP(ocp(), intervals=30, threads=2).solve,
    "LQR": lambda _: LQR(ocp()),
    "LQR's value": lambda _: LQR(ocp()).value,
    "LQR, infinite": lambda _: LQR(ocp(), infinite=True),
    "CND": lambda _: cnd(),
    "CND's value": lambda _: both_values(cnd()),
    "CND in CasADi": lambda _: rows_of(cnd().to_casadi(), np.full((1, ROWS), 0.5)),
    "V in CasADi": lambda _: rows_of(cnd().value_to_casadi(), np.full((1, ROWS), 0.5)),
    "CND in C": compiled,
    "judge, plans": lambda _: lambda x: nocl.simulate(ocp(), np.ones((len(x), 20, 1)), x).x,
    "judge, feedback": lambda _: lambda x: nocl.simulate(ocp(), cnd(), x[:2]).x,
    "System.f": lambda _: rows_of(ocp().system.f, U),
    "System.jacobian": lambda _: rows_of(ocp().system.jacobian, U),
    "System.linearize": lambda _: linearised(ocp().system),
    "to_torch": lambda _: of_torch(nocl.to_torch(ocp().system.f)),
    "model": lambda _: of_torch(model()),
    "model in CasADi": lambda _: rows_of(model().to_casadi(), U),
}


def array(answer):
    if isinstance(answer, nocl.Solution):
        return np.concatenate([answer.u.ravel(), answer.V.ravel(), answer.gain.ravel()])
    return answer.detach().numpy() if isinstance(answer, torch.Tensor) else np.asarray(answer)


def states(number):
    return ocp().initial_states.sample(ROWS, 10 + number)


@pytest.mark.parametrize("shared", [True, False], ids=["one object", "an object each"])
@pytest.mark.parametrize("name", OBJECTS)
def test_threads_get_the_answers_of_one(name, shared, tmp_path):
    make, first = OBJECTS[name], OBJECTS[name](tmp_path)
    right = [array(first(states(i))) for i in range(THREADS)]
    got, together = {}, threading.Barrier(THREADS)

    def work(number):
        together.wait()
        call = first if shared else make(tmp_path)
        got[number] = [array(call(states(number))) for _ in range(CALLS)]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is said once, is not said here
        threads = [threading.Thread(target=work, args=(i,)) for i in range(THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sorted(got) == list(range(THREADS))
    for number, answers in got.items():
        for answer in answers:
            np.testing.assert_array_equal(answer, right[number])
