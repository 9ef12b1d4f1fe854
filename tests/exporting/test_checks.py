"""Checks that go from one model's contract into others', in place."""

import pytest
from edge_samples import make_contract, make_pad_contract, write_model
from pose_samples import make_posed_contract, write_posed_model
from trust_samples import make_posed_trust, make_trust, make_trusted_contract

from edge.inference.onnx_session import ModelSession
from export.checks import main


def checks_of(path):
    trust = ModelSession(path).contract.read_trust()
    assert trust is not None
    return trust.to_json()


def test_a_model_without_checks_gets_them_and_one_of_poses_keeps_those_of_its_taps(tmp_path):
    source = write_model(tmp_path / "source.onnx", make_trusted_contract())
    plain = write_model(tmp_path / "plain.onnx", make_trusted_contract(trust={}))
    own = make_posed_trust(4.0).to_json() | {"contact": {**make_trust().to_json()["contact"], "limit": 1.0}}
    shared = {key: getattr(make_trusted_contract(), key) for key in ("pad_inputs", "takes_gains", "output_full_scale")}
    posed = write_posed_model(tmp_path / "posed.onnx", make_posed_contract(trust=own, **shared))
    main([str(source), str(plain), str(posed)])
    assert checks_of(plain) == checks_of(source) == make_trust().to_json()
    assert checks_of(posed) == {**make_trust().to_json(), "tap": own["tap"]}


@pytest.mark.parametrize(
    ("source", "target", "told"),
    [
        (make_pad_contract(), make_trusted_contract(), "has no checks"),
        (make_trusted_contract(), make_contract(), "differs from .* in pad_inputs, takes_gains"),
        (make_trusted_contract(), None, "none.onnx"),
    ],
)
def test_what_cannot_be_given_is_told_in_a_line(tmp_path, source, target, told):
    source = write_model(tmp_path / "source.onnx", source)
    path = tmp_path / "none.onnx" if target is None else write_model(tmp_path / "target.onnx", target)
    with pytest.raises(SystemExit, match=told):
        main([str(source), str(path)])
