"""Writer of models: evaluates them on the frozen test set, fits their confidence, and describes each in a line."""

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import onnx

from edge.evaluation.metrics import judge_model, mean_error
from edge.evaluation.test_set import FrozenSet
from edge.inference.contract import ANY_BATCH, Contract
from edge.inference.onnx_session import ModelSession, load_session
from edge.inference.trust import Trust
from edge.terminal.progress_bar import tracked
from firmware_bridge.in_place import write_in_place
from train.learning.expected_error_table import fit_confidence
from train.networks.graph_weights import origin


@dataclass(frozen=True, slots=True)
class Writer:
    """Writer for all models of a checkpoint; the attributes are those of `export.to_onnx.export`.

    Errors are those of a batch of one, in the runtime's own session; a model of another scale than the frozen set's is
    not evaluated.
    """

    folder: Path
    frozen: FrozenSet
    validation: Sequence[FrozenSet]
    report: Mapping[str, Any]
    trust: Trust | None = None

    def error(self, single: onnx.ModelProto, contract: Contract) -> dict[str, float]:
        """Return the mean errors of a graph of one window or any number, with all taps; empty if it is not judged."""
        if contract.scale != self.frozen.scale:
            return {}
        return mean_error(judge_model(self._session("judged", single, contract), self.frozen))

    def write(
        self, name: str, model: onnx.ModelProto, single: onnx.ModelProto, contract: Contract, facts: Sequence[str]
    ) -> str:
        """Write NAME.onnx, and return the line that describes it."""
        # The evaluated graph is the written one wherever the runtime can run it.
        session = self._session(name, model if contract.batch == ANY_BATCH else single, contract)
        parts = [f"x{contract.scale}"]
        if contract.scale == self.frozen.scale:
            for given in tracked(range(1, contract.taps + 1), "judging", "run"):
                contract.test_error[str(given)] = mean_error(judge_model(session, self.frozen, given))
            error = contract.test_error[str(contract.taps)]
            parts.append(f"{error['psnr_db']:.2f} dB, SSIM {error['ssim']:.3f}")
            if "coverage_90" in error:
                parts.append(f"interval covers {error['coverage_90']:.1%}")
        else:
            parts.append(f"not evaluated, the test set is of x{self.frozen.scale}")
        fitting = [one for one in self.validation if one.scale == contract.scale]
        if fitting and session.deviation is not None:
            contract.confidence.update(fit_confidence(session, fitting))
        # Several taps are checked by their poses: a model that takes none would be believed whatever they are.
        checkable = contract.taps == 1 or contract.takes_poses
        if self.trust is not None and checkable and contract.pad_inputs and contract.traction_scale:
            contract.trust.update(self.trust.to_json())
        content = _content(model, contract, origin(self.report))
        Contract.from_metadata({entry.key: entry.value for entry in model.metadata_props})  # checked as in the runtime
        write_in_place(self.folder / f"{name}.onnx", lambda draft: draft.write_bytes(content), load_session)
        return f"{name}.onnx: {len(content) / 1e6:.2f} MB, {', '.join([*parts, *facts])}"

    def _session(self, name: str, single: onnx.ModelProto, contract: Contract) -> ModelSession:
        with tempfile.TemporaryDirectory() as drafts:
            draft = Path(drafts) / f"{name}.onnx"
            batch = contract.batch if contract.batch == ANY_BATCH else 1
            draft.write_bytes(_content(single, replace(contract, batch=batch)))
            return ModelSession(draft)


def _content(model: onnx.ModelProto, contract: Contract, stated: Mapping[str, str] = MappingProxyType({})) -> bytes:
    """Return a file's content, the same for the same model, contract and further metadata."""
    del model.metadata_props[:]
    for key, value in {**contract.to_metadata(), **stated}.items():
        model.metadata_props.add(key=key, value=value)
    return model.SerializeToString(deterministic=True)
