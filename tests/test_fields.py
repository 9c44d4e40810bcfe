"""Settings: every field has a doc and a rule, errors say got / expected, one word scales what belongs together."""

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from nocl.cli.commands import parser
from nocl.cli.run_folder import RunFolder
from nocl.solvers.cnd.settings import PaperSettings, TrainSettings
from nocl.solvers.ddp.solver import DDPSettings
from nocl.solvers.neural_oc import NeuralOCSettings
from nocl.support.fields import RULE, Checked, choice, coefficients, count, flag, nonnegative, positive, widths
from nocl.sysid import settings as sysid

CLASSES = (TrainSettings, PaperSettings, DDPSettings, NeuralOCSettings, sysid.Settings, sysid.LogSettings,
           sysid.PaperSettings)
SCALED = (TrainSettings, sysid.Settings, sysid.LogSettings)
nan, inf = float("nan"), float("inf")


@dataclass(frozen=True)
class Tried(Checked):
    """A field of each kind; annotations say nothing on purpose."""

    n: object = count(3, "how many")
    n0: object = count(0, "how many, perhaps none", least=0)
    some: object = count(None, "how many of them", none="all")
    a: object = positive(0.5, "a share", most=1)
    b: object = nonnegative(0.0, "a weight")
    on: object = flag(False, "whether")
    word: object = choice("x", "which", ("x", "y"))
    hidden: object = widths((4,), "of layers")
    c: object = coefficients((1.0, 0.0), "of two terms", nonzero=1)


@pytest.mark.parametrize(("name", "bad"), [
    *(("n", v) for v in (0, -1, 2.0, True, "3", None, nan, [3], np.arange(2))),
    *(("n0", v) for v in (-1, False)), *(("some", v) for v in (0, 1.5, "all")),
    *(("a", v) for v in (0, -1.0, 1.5, nan, inf, True, "1", None, 1j)),
    *(("b", v) for v in (-1e-300, nan, inf, False, None)), *(("on", v) for v in (0, 1, None, "yes", np.True_)),
    *(("word", v) for v in ("z", 1, None, ["x"])),
    *(("hidden", v) for v in ((), (4, 0), (4.0,), 4, None, "44", (True,), [[4]])),
    *(("c", v) for v in ((0, 1), (1,), (1, -1), (1, nan), 1.0, (1, 1, 1), ("1", "1"), None))])
def test_what_a_field_cannot_be_is_told_with_what_it_means(name, bad):
    doc = {f.name: f.metadata[RULE].doc for f in fields(Tried)}[name]
    with pytest.raises(ValueError, match=rf"^Tried: {name} is .*; expected .*\({doc}\)$"):
        Tried(**{name: bad})
    with pytest.raises(ValueError, match=f"^Tried: {name} is "):
        replace(Tried(), **{name: bad})


def test_what_a_field_may_be_is_kept_as_plain_python():
    s = Tried(n=np.int64(5), n0=0, some=7, a=1, b=np.float32(2), on=True, word="y", hidden=[np.int32(3), 2], c=[1, 0])
    assert (s.n, s.some, s.a, s.b, s.hidden, s.c) == (5, 7, 1.0, 2.0, (3, 2), (1.0, 0.0))
    assert [type(v) for v in (s.n, s.a, s.b, s.hidden[0], s.c[0])] == [int, float, float, int, float]
    assert Tried(some=None).some is None


@pytest.mark.parametrize("cls", CLASSES)
def test_every_field_of_settings_is_checked_and_documented(cls):
    for f in fields(cls):
        assert f.metadata[RULE].doc
        with pytest.raises(ValueError, match=f"{cls.__name__}: {f.name} is .*expected"):
            cls(**{f.name: object()})


@pytest.mark.parametrize("cls", SCALED)
def test_one_word_scales_the_settings(cls):
    quick, normal, best = (cls.of(effort) for effort in ("quick", "normal", "best"))
    assert normal == cls()
    assert len({repr(s) for s in (quick, normal, best)}) == 3
    for name in cls.EFFORT["quick"]:
        assert getattr(normal, name) is None or getattr(quick, name) < getattr(normal, name)
    for name in cls.EFFORT["best"]:
        a, b = getattr(normal, name), getattr(best, name)
        assert a is None or (b < a if name in ("gap_median", "gap_p95", "value_error") else b > a)
    with pytest.raises(ValueError, match=rf"{cls.__name__}: effort is 'fast'; expected 'quick', 'normal' or 'best'"):
        cls.of("fast")


def test_single_fields_may_differ_from_an_effort():
    assert TrainSettings.of("best", seeds=3) == replace(TrainSettings.of("best"), seeds=3)
    with pytest.raises(ValueError, match="seeds is 0"):
        TrainSettings.of("best", seeds=0)


@pytest.mark.parametrize("command", ["run", "identify", "train"])
def test_the_command_line_takes_the_word(command):
    def effort(*words):
        return parser().parse_args([command, "pendulum", *words]).effort

    assert effort() == "normal"
    assert [effort("--effort", word) for word in ("quick", "normal", "best")] == ["quick", "normal", "best"]
    assert effort("--quick") == "quick"
    with pytest.raises(ValueError, match="--effort"):
        effort("--effort", "fast")


def test_a_run_of_before_is_taken_up(tmp_path):
    """Cards of older runs say `quick` in place of the effort."""
    import nocl
    from nocl.cli.run_folder import KEY, _ours

    class Saved:
        def __init__(self, made_from):
            self.card = {KEY: made_from}

    now = RunFolder(nocl.load_ocp("pendulum"), tmp_path, 3)._made_from(exact=True)
    for quick, effort in ((False, "normal"), (True, "quick")):
        before = {k: v for k, v in now.items() if k != "effort"} | {"quick": quick}
        assert _ours(Saved(before), tmp_path).card[KEY] == now | {"effort": effort}
