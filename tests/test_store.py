"""What is stored comes back bit by bit, and what is broken says so."""

from __future__ import annotations

import json
import os

import casadi as ca
import numpy as np
import pytest
import torch

from nocl import records
from nocl.nets import MLP, FeatureNet
from nocl.support import store


def network(dtype: torch.dtype = torch.float64, skip: bool = True) -> FeatureNet:
    """(x [2], t) -> u [1] with two networks, scaled and limited."""
    x, t, y, z = ca.SX.sym("x", 2), ca.SX.sym("t"), ca.SX.sym("y"), ca.SX.sym("z", 2)
    inputs = ca.Function("inputs", [x, t], [ca.vertcat(ca.sin(x[0]), x[1] / 3, t), x], ["x", "t"], ["a", "b"])
    outputs = ca.Function("outputs", [x, t, y, z], [ca.fmin(y + 0.1 * z[0] * z[1], 2)], ["x", "t", "y", "z"], ["u"])
    return FeatureNet(inputs, [MLP([3, 8, 1], "sine", skip), MLP([2, 4, 4, 2])], outputs).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_network_comes_back_bit_by_bit(tmp_path, dtype):
    net = network(dtype)
    rng = torch.get_rng_state()
    path = records.save_net(tmp_path / "new", "controller", net)
    again = records.load_net(tmp_path / "new", "controller")
    assert torch.equal(rng, torch.get_rng_state())  # loading draws nothing
    assert [p.name for p in path.parent.iterdir()] == ["controller.safetensors"]
    expected, got = net.state_dict(), again.state_dict()
    assert list(expected) == list(got)
    for key, value in expected.items():
        assert got[key].dtype == value.dtype == dtype
        assert torch.equal(got[key], value)
    assert all(p.requires_grad for p in again.parameters())
    x, t = torch.randn(7, 2, dtype=dtype), torch.randn(7, 1, dtype=dtype)
    assert torch.equal(net(x, t), again(x, t))


def test_several_records_share_a_folder_and_the_last_save_counts(tmp_path):
    controller, value, other = network(), network(skip=False), network()
    records.save_net(tmp_path, "controller", controller)
    records.save_net(tmp_path, "value", value)
    records.save_net(tmp_path, "controller", other)
    assert torch.equal(records.load_net(tmp_path, "controller").nets[0].body[0].weight, other.nets[0].body[0].weight)
    assert records.load_net(tmp_path, "value").nets[0].skip is None
    assert sorted(p.name for p in tmp_path.iterdir()) == ["controller.safetensors", "value.safetensors"]


def test_a_record_holds_networks_functions_and_a_card(tmp_path):
    x = ca.SX.sym("x", 2)
    f = ca.Function("f", [x], [x / 3 + ca.sin(x[0])], ["x"], ["xdot"])
    nets = {"a": network(), "b": network()}
    records.save(tmp_path, "cnd", nets=nets, functions={"f": f}, card={"seed": 3, "names": ["x"]})
    record = records.load(tmp_path, "cnd")
    assert set(record.nets) == {"a", "b"}
    assert record.card == {"seed": 3, "names": ["x"]}
    assert np.array_equal(record.functions["f"]([0.1, 0.7]).full(), f([0.1, 0.7]).full())


def broken(good: bytes) -> dict[str, bytes]:
    flipped = bytearray(good)
    flipped[-3] ^= 1
    n = int.from_bytes(good[:8], "little")
    header = json.loads(good[8:8 + n])
    header["__metadata__"]["format"] = "99"
    future = json.dumps(header).encode()
    return {"empty": b"", "cut in its header": good[:50], "cut in its weights": good[:-8], "longer": good + b"\0" * 8,
            "a flipped bit": bytes(flipped), "an edited structure": good.replace(b"OP_SIN", b"OP_COS"),
            "of another format": len(future).to_bytes(8, "little") + future + good[8 + n:], "text": b"hello, world"}


def test_broken_files_are_refused_by_name(tmp_path):
    path = records.save_net(tmp_path, "net", network())
    good = path.read_bytes()
    for what, content in broken(good).items():
        path.write_bytes(content)
        with pytest.raises(ValueError, match=str(path)):
            pytest.fail(f"{what}: loaded {records.load_net(tmp_path, 'net')}")
    path.write_bytes(good)
    records.load_net(tmp_path, "net")


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="is not a folder"):
        records.load_net(tmp_path / "nowhere", "net")
    path = records.save_net(tmp_path, "value", network())
    with pytest.raises(ValueError, match=r"no controller\.safetensors \(records there: value"):
        records.load_net(tmp_path, "controller")
    path.rename(tmp_path / "controller.safetensors")
    with pytest.raises(ValueError, match="is a 'value' of nocl's; expected a 'controller'"):
        records.load_net(tmp_path, "controller")
    store.save_checkpoint(tmp_path / "state", {"a": 1})
    with pytest.raises(ValueError, match="expected letters"):
        records.save_net(tmp_path, "../net", network())
    with pytest.raises(ValueError, match="expected a checkpoint"):
        store.load_checkpoint(tmp_path / "none")
    records.save(tmp_path, "pair", nets={"a": network(), "b": network()})
    with pytest.raises(ValueError, match="expected one network"):
        records.load_net(tmp_path, "pair")


def test_wrong_tensor_shapes_are_refused(tmp_path):
    net = network()
    net.nets[0].sizes = (3, 9, 1)  # a structure that the weights do not fit
    records.save_net(tmp_path, "net", net)
    with pytest.raises(ValueError, match=r"nets\.0\.body\.0\.bias has shape \(8,\), expected \(9,\)"):
        records.load_net(tmp_path, "net")


def test_only_data_is_stored(tmp_path):
    with pytest.raises(ValueError, match="expected a nocl"):
        records.save_net(tmp_path, "net", torch.nn.Linear(1, 1))
    with pytest.raises(ValueError, match="expected plain data"):
        records.save(tmp_path, "cnd", nets={}, card={"a": object()})
    with pytest.raises(ValueError, match=r"state\.a is a object"):
        store.save_checkpoint(tmp_path / "c", {"a": object()})
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_former_file(tmp_path, monkeypatch):
    path = store.write_json(tmp_path / "card.json", {"a": 1})

    def full(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ValueError, match="No space left"):
        store.write_json(path, {"a": 2})
    assert store.read_json(path) == {"a": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["card.json"]


def test_json_is_standard(tmp_path):
    data = {"a": np.float64(0.1), "b": np.arange(2), "c": [np.inf, -np.inf, np.nan], "d": (True, None),
            3: np.bool_(True)}
    path = store.write_json(tmp_path / "x.json", data)
    assert json.loads(path.read_text(), parse_constant=pytest.fail) == {
        "a": 0.1, "b": [0, 1], "c": ["inf", "-inf", "nan"], "d": [True, None], "3": True}
    with pytest.raises(ValueError, match="a: b is a object"):
        store.write_json(path, {"a": {"b": object()}})
    path.write_text('{"a": ')
    with pytest.raises(ValueError, match="is not JSON"):
        store.read_json(path)
    with pytest.raises(ValueError, match="cannot be read"):
        store.read_json(tmp_path / "none.json")


def test_training_resumes_exactly_from_a_checkpoint(tmp_path):
    """Adam and a random generator, stopped after 3 of 6 steps, give the very weights of 6 steps in one go."""
    def step(net, optimizer, rng):
        x = torch.from_numpy(rng.standard_normal((16, 2)))
        optimizer.zero_grad()
        (net(x, x[:, :1]) ** 2).mean().backward()
        optimizer.step()

    net = network()
    rng, optimizer = np.random.default_rng(5), torch.optim.Adam(net.parameters(), lr=0.01)
    for _ in range(3):
        step(net, optimizer, rng)
    state = {"net": net.state_dict(), "optimizer": optimizer.state_dict(), "rng": rng.bit_generator.state}
    store.save_checkpoint(tmp_path / "run.checkpoint", state, {"iteration": 3})
    for _ in range(3):
        step(net, optimizer, rng)

    state, meta = store.load_checkpoint(tmp_path / "run.checkpoint")
    assert meta == {"iteration": 3}
    again = network()
    again.load_state_dict(state["net"])
    rng2, optimizer2 = np.random.default_rng(0), torch.optim.Adam(again.parameters(), lr=0.5)
    optimizer2.load_state_dict(state["optimizer"])
    rng2.bit_generator.state = state["rng"]
    for _ in range(3):
        step(again, optimizer2, rng2)
    for p, q in zip(net.parameters(), again.parameters(), strict=True):
        assert torch.equal(p, q)


def test_checkpoints_keep_types_and_nesting(tmp_path):
    shared = torch.arange(6.0).reshape(2, 3)
    state = {"list": [shared, shared.T, None], 0: (1, 2.5, True, "x"), "array": np.arange(4, dtype=np.int16),
             "s": np.float32(0.1), "empty": {}, "zero": torch.zeros(0, 3), "scalar": torch.tensor(7),
             "big": 2**127 + 1, "inf": float("-inf")}
    again, _ = store.load_checkpoint(store.save_checkpoint(tmp_path / "c", state))
    assert list(again) == list(state)
    assert torch.equal(again["list"][1], shared.T)
    assert again["list"][2] is None
    assert again[0] == (1, 2.5, True, "x")
    assert again["array"].dtype == np.int16
    assert again["s"] == np.float32(0.1)
    assert again["zero"].shape == (0, 3)
    assert (again["scalar"].item(), again["big"], again["inf"]) == (7, 2**127 + 1, float("-inf"))
