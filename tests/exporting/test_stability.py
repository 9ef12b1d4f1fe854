"""The stability report: every row holds, and what is broken is seen."""

import csv
from importlib import import_module

import numpy as np
import pytest

from edge.errors import ModelError
from export.stability import __main__ as command
from export.stability import counts, layer_contact, magnets, networks, pareto, psf
from export.stability.case import Case, refused
from firmware_bridge.pad_geometry import USPA44
from train.physics.contact import ContactSolver
from train.physics.elastic_layer import Layer
from train.physics.magnets import Magnet, MagnetArray

CHEAP = tuple(part for part in command.PARTS if part != "finite_elements")
NAME = "-".join(["stability", *CHEAP, "quick"])


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def reports(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports")
    assert command.run(CHEAP, folder, quick=True) == []
    return folder


@pytest.mark.parametrize("part", CHEAP)
def test_every_row_of_a_part_holds_and_none_is_left_out(reports, part):
    named = next(import_module(f"export.stability.{part}").cases(True)).part
    rows = [row for row in rows_of(reports / f"{NAME}.csv") if row["part"] == named]
    assert len(rows) > 5 and {row["verdict"] for row in rows} <= {"holds", "refused", "limit"}


def test_the_page_counts_its_rows_and_has_a_picture(reports):
    page = (reports / f"{NAME}.md").read_text()
    assert "0 are broken" in page and "BROKEN" not in page
    assert (reports / f"{NAME}.png").stat().st_size > 10_000


def case(value, most, **more):
    return Case("part", "case", "much", "error", value, most, **more)


@pytest.mark.parametrize(
    ("made", "holds"),
    [
        (case(1e-3, 1e-3), True),
        (case(1.1e-3, 1e-3), False),
        (case(float("nan"), 1e-3), False),
        (case(float("inf"), 1e-3), False),
        (case(None, 1e-3), False),
        (case(1.0, None), False),
        (case(1.0, None, limit=True), False),
        (case(1.0, None, limit=True, least=0.5), True),
        (case(0.4, None, limit=True, least=0.5), False),
        (case(float("nan"), None, limit=True, least=0.5), False),
        (case(0.7, 0.8, guard="ValueError: no"), True),
        (case(1.0, 0.8, guard="ValueError: no"), False),
        (case(None, None, guard="ValueError: no"), True),
    ],
)
def test_what_is_not_within_its_bound_is_broken(made, holds):
    assert made.holds is holds and (made.cells()["verdict"] == "BROKEN") is not holds


def test_a_guard_that_is_gone_is_broken():
    assert refused("part", "case", "much", lambda: [].remove(1), ValueError, "not in list").holds
    assert not refused("part", "case", "much", lambda: [].remove(1), ValueError, "another guard").holds
    assert not refused("part", "case", "much", lambda: None, ValueError).holds
    with pytest.raises(KeyError):
        refused("part", "case", "much", lambda: {}["a"], ValueError)


def test_a_broken_row_ends_the_command_with_its_name(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(counts, "cases", lambda _quick: iter([case(2.0, 1.0), case(0.5, 1.0)]))
    with pytest.raises(SystemExit, match="stability: 1 rows are broken:\n  part: case, much, error"):
        command.main(["counts", "--reports", str(tmp_path)])
    assert (
        "BROKEN" in (tmp_path / "stability-counts.csv").read_text()
        and "### Broken" in (tmp_path / "stability-counts.md").read_text()
    )
    assert capsys.readouterr().out.endswith("stability-counts.md\n")


def test_an_unknown_part_is_a_usage_error(capsys):
    with pytest.raises(SystemExit) as end:
        command.main(["magic"])
    assert end.value.code == 2 and "layer_contact" in capsys.readouterr().err


def test_a_thick_layer_needs_a_wide_grid(monkeypatch):
    """The row that detected it: on twice the pad, copies of the pad had an effect."""
    monkeypatch.setattr("train.physics.contact._DIES_WITHIN", 0)
    holds = [layer_contact.against_a_wide_grid(Layer(thickness_mm=h), f"{h} mm").holds for h in (4.5, 10, 50)]
    assert holds == [True, False, False]


def test_the_default_layer_is_solved_on_the_grid_it_always_was():
    solver = ContactSolver(Layer(), 42, 0.47)
    assert solver._kernel.shape == (84, 84)


def test_a_dipole_too_near_is_refused_and_a_cylinder_is_not():
    near = Magnet(height_mm=1.0)
    with pytest.raises(ValueError, match=r"within 0\.25 mm of its chip, .* take field='cylinder'"):
        MagnetArray(USPA44, near)
    MagnetArray(USPA44, near, "cylinder")
    assert [row for row in magnets.cases() if not row.holds] == []


def test_a_small_gamma_keeps_the_last_digits_of_distances():
    rows = [row for row in psf.cases() if row.case == "degradation, paper"]
    assert rows[0].severity == "gamma 0.001" and rows[0].value is not None and rows[0].value < 1e-6


def test_nothing_is_made_of_saturated_chips(monkeypatch):
    assert counts.saturated(-1).holds and counts.saturated(65535).holds
    monkeypatch.setattr(
        "edge.perception.taxel_health.FROZEN_SENSOR_SCANS", 10**9
    )  # a second guard, or the first is not seen missing
    assert counts.saturated(-1).holds and counts.saturated(65535).holds
    monkeypatch.setattr("edge.perception.taxel_health.RANGE_ENDS", (-2, -2))
    assert not counts.saturated(-1).holds and not counts.saturated(65535).holds


def test_a_network_that_gives_what_is_not_finite_is_broken(monkeypatch):
    class Wild(networks.GraphRun):
        def __call__(self, windows):
            return [maps * np.float32(np.nan) for maps in super().__call__(windows)]

    monkeypatch.setattr(networks, "GraphRun", Wild)
    assert not any(row.holds for row in networks.cases(True))


def test_error_falls_and_run_time_rises_as_the_grid_gets_finer():
    rows = [row for row in pareto.simulation(quick=True) if row["series"] == "grid" and row["precision"] == "float32"]
    errors = [float(str(row["error %"])) for row in rows if row["note"] != pareto.SHIPPED]
    assert errors[0] > 1 and errors == sorted(errors, reverse=True)
    assert [row["setting"] for row in rows if row["note"] == pareto.SHIPPED] == ["42 x 0.47 mm"]


def test_networks_have_error_and_run_time_in_one_row():
    rows = pareto.networks(quick=True)
    assert all(float(str(row["p50 us"])) > 0 and float(str(row["PSNR dB"])) > 15 for row in rows)
    assert {row["arithmetic"] for row in rows} == {"float32", "int8"}


def test_without_fig7_there_are_no_finite_elements(tmp_path):
    assert pareto.finite_elements(tmp_path) == []


def test_a_model_of_an_older_contract_ends_in_one_line(tmp_path, monkeypatch):
    def old(_quick):
        raise ModelError("stsr.onnx: contract key 'version' is 2, expected 3")
        yield

    monkeypatch.setattr(networks, "cases", old)
    with pytest.raises(SystemExit, match=r"^stability: stsr\.onnx"):
        command.main(["networks", "--reports", str(tmp_path)])


def test_a_network_that_says_nothing_is_broken(monkeypatch):
    """Nothing at all lies within half of full scale of a light press."""

    class Mute(networks.GraphRun):
        def __call__(self, windows):
            pattern, deviation, traction = super().__call__(windows)
            return [pattern * 0, deviation * 0 + np.float32(1e-6), traction]

    monkeypatch.setattr(networks, "GraphRun", Mute)
    found = [row for row in networks.cases() if row.case.endswith("-int8") and row.severity.endswith("taps")]
    assert found and not any(row.holds for row in found)


def test_a_pad_that_rests_at_its_wrap_is_not_saturated(monkeypatch):
    monkeypatch.setattr("edge.perception.taxel_health.NEAR_END_COUNTS", -1.0)
    assert not all(counts.resting(rest).holds for rest in (0, 1, 65534, 65535))


def test_what_lacks_is_said_before_anything_is_worked_out(tmp_path, monkeypatch):
    def lacking(part):
        raise ModuleNotFoundError("the FEM reference needs felupe (GPL)")

    monkeypatch.setattr(command, "_cases", lacking)
    with pytest.raises(SystemExit, match=r"^stability: the FEM reference needs felupe"):
        command.main(["--reports", str(tmp_path)])
    assert list(tmp_path.iterdir()) == []
