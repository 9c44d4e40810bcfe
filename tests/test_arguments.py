"""What is no number, no file of nocl's, or made for another problem, is refused by a ValueError that says so."""

import datetime

import casadi as ca
import numpy as np
import pytest
import torch

import nocl
from nocl.solvers.lqr import LQR
from nocl.solvers.nmpc.solver import NMPC
from nocl.support import checks, store
from nocl.sysid import Settings

NO_NUMBERS = {
    "masked": np.ma.array([0.1, 0.2], mask=[False, True]), "text": ["0.1", "0.2"], "bytes": [b"1", b"2"],
    "complex": [0.1 + 0j, 0.2], "bools": [True, False], "dates": np.array(["2020", "2021"], dtype="M8[Y]"),
    "spans": np.array([1, 2], dtype="m8[s]"), "a date": [datetime.date(2020, 1, 1), 0.2], "None": [None, 0.2],
    "ragged": [[0.1, 0.2], [0.3]], "a dict": {"theta": 0.1, "omega": 0.2}, "an object": object(),
    "a huge integer": [10**400, 1], "a gradient": torch.tensor([0.1, 0.2], requires_grad=True)}


class Table:
    """What pandas' DataFrame looks like to numpy, with the columns in another order than the states."""

    columns = ("omega", "theta")
    dtypes = None

    def __array__(self, dtype=None, copy=None):
        return np.zeros((3, 2))


@pytest.fixture(scope="module")
def pendulum():
    return nocl.load_ocp("pendulum")


@pytest.mark.parametrize("what", [*NO_NUMBERS, "a table"])
def test_states_that_are_no_numbers_are_refused(pendulum, what):
    x = Table() if what == "a table" else NO_NUMBERS[what]
    law = LQR(pendulum)
    for call in (law, lambda x0: nocl.simulate(pendulum, law, x0), lambda x0: NMPC(pendulum).solve(x0)):
        with pytest.raises(ValueError, match=r"expected an array|pass numbers"):
            call(x)


@pytest.mark.parametrize("x", [[1, 2], np.array([1, 2], dtype=object), (np.float32(1), 2), torch.tensor([1, 2])])
def test_numbers_in_other_clothes_are_taken(x):
    rows, single = checks.states(x, 2, "a system")
    assert single
    assert rows.dtype == np.float64
    assert rows.tolist() == [[1.0, 2.0]]


def test_what_is_taken_is_a_copy():
    x = np.zeros(2)
    checks.states(x, 2, "a system")[0][0, 0] = 1.0
    assert x[0] == 0.0


def test_weights_that_are_not_finite_are_refused_at_loading(tmp_path):
    cnd = nocl.pretrained("pendulum")
    with torch.no_grad():
        cnd.policy.nets[0].body[0].weight[0, 0] = float("nan")
    cnd.save(tmp_path)
    with pytest.raises(ValueError, match=r"policy: the tensor .* holds NaN or inf"):
        nocl.CND.load(tmp_path)


STRUCTURES = {"a list": [], "nets a list": {"nets": [1], "functions": {}, "card": {}},
              "no sizes": {"nets": {"policy": {"nets": [{}]}}, "functions": {}, "card": {}},
              "deep": None, "a wrong index": {"nets": {}, "functions": {"f": {
                  "name": "f", "work": 1, "inputs": [["x", 1, 1]], "outputs": [["y", 1, 1]],
                  "code": [["OP_INPUT", 7, 0, 0]]}}, "card": {}}}


@pytest.mark.parametrize("what", STRUCTURES)
def test_files_with_a_true_digest_and_a_false_structure_are_refused(tmp_path, what):
    structure = STRUCTURES[what]
    if what == "deep":
        structure = []
        for _ in range(900):
            structure = [structure]
        structure = {"nets": structure, "functions": {}, "card": {}}
    store.write_tensors(tmp_path / "cnd.safetensors", "cnd", {"a": torch.zeros(1)}, structure)
    with pytest.raises(ValueError, match=r"structure|controller|function"):
        nocl.CND.load(tmp_path)


def other_pendulum(name="theta", gravity=3.7):
    theta, omega, tau = ca.SX.sym(name), ca.SX.sym("omega"), ca.SX.sym("tau")
    s = nocl.System("mars", x=ca.vertcat(theta, omega), u=tau, xdot=ca.vertcat(omega, gravity * ca.sin(theta) + tau),
                    lbu=[-5], ubu=[5], lbx=[-6, -8], ubx=[6, 8], angles=[name])
    return nocl.OCP(s, horizon=3.0, running=0.01 * tau**2, terminal=theta**2 + omega**2, x_goal=[0, 0], u_goal=[0],
                    initial_states=nocl.Gaussian([3.1, 0], [0.1, 0.1]))


@pytest.mark.parametrize(("change", "match"), [({}, r"equation\(s\) of omega are others"),
                                               ({"name": "phi"}, "its states are")])
def test_a_controller_of_another_system_of_the_same_sizes_is_refused(pendulum, change, match):
    cnd, mars = nocl.pretrained("pendulum"), other_pendulum(**change)
    for call in (lambda: nocl.simulate(mars, cnd, [3.0, 0.0]), lambda: NMPC(mars, terminal=cnd).solve([3.0, 0.0]),
                 lambda: NMPC(mars, 20).solve([3.0, 0.0], cnd, workers=1),
                 lambda: nocl.comparisons.compare(mars, {"CND": cnd}, n=1)):
        with pytest.raises(ValueError, match=match):
            call()
    if not change:  # what is built on a model on the spot may be tried on the plant
        assert nocl.simulate(mars, LQR(pendulum), [0.05, 0.0]).success.all()
    plant = mars.system.f  # the same controller on another plant: by saying so
    assert nocl.simulate(pendulum, cnd, [3.0, 0.0], f=plant).success.all()


def test_the_same_equations_written_otherwise_are_the_same_system(pendulum):
    s = pendulum.system
    again = nocl.System.from_casadi(s.f.wrap(), states=s.state_names, controls=s.control_names, lbu=s.lbu, ubu=s.ubu,
                                    lbx=s.lbx, ubx=s.ubx)
    assert s.difference(again) == "" == s.difference(s)


MODELS = {"no card": lambda s: s.pop("card"), "no net": lambda s: s["nets"].clear(),
          "a list": lambda s: s.update(card=[]), "no structure": lambda s: s["card"].pop("structure"),
          "a wrong part": lambda s: s["card"].update(parts=3), "no functions": lambda s: s["functions"].pop("linear"),
          "a number": lambda s: s["card"].update(system=1)}


@pytest.fixture(scope="module")
def model(pendulum):
    small = Settings(iterations=1, polish=0, samples=100, width=4, structure=False)
    return nocl.identify(pendulum.system, settings=small, progress=False)


@pytest.mark.parametrize("what", MODELS)
def test_malformed_models_are_refused(model, tmp_path, what):
    model.save(tmp_path)
    tensors, structure = store.read_tensors(tmp_path / "dynamics.safetensors", "dynamics")
    MODELS[what](structure)
    store.write_tensors(tmp_path / "dynamics.safetensors", "dynamics", tensors, structure)
    with pytest.raises(ValueError, match=r"expected a .* that nocl wrote: save it again"):
        nocl.LearnedDynamics.load(tmp_path)


@pytest.mark.parametrize("dtype", [torch.complex64, torch.int64])
def test_weights_that_are_no_real_numbers_are_refused(model, tmp_path, dtype):
    model.save(tmp_path)
    path = tmp_path / "dynamics.safetensors"
    tensors, structure = store.read_tensors(path, "dynamics")
    store.write_tensors(path, "dynamics", {key: value.to(dtype) for key, value in tensors.items()}, structure)
    with pytest.raises(ValueError, match="expected real weights"):
        nocl.LearnedDynamics.load(tmp_path)
