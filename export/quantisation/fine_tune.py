"""Fine-tuning of networks with the rounding of their quantised graphs, where quantisation alone costs too much."""

import contextlib
import copy
import hashlib
import json
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.evaluation.test_set import FrozenSet
from export.graphs.graph import to_model
from export.graphs.parity import GraphRun
from export.quantisation.int8 import quantised
from export.quantisation.rounding import integer_convolutions, rounded
from firmware_bridge.pad_geometry import SensorGeometry
from train.data.batch import Batch
from train.data.batches import network_input
from train.data.dataset import Sequences
from train.data.presses import PressSet
from train.fit import given_taps
from train.learning.checkpoint import batches_of
from train.learning.interval_calibration import calibrate
from train.learning.training_loop import Recipe, train
from train.networks.blocks import PatternNet
from train.networks.compact import CompactNet, HeteroscedasticError
from train.networks.losses import RelativeError


@dataclass(frozen=True, slots=True)
class FineTuning:
    """Settings for the fine-tuning of networks for int8.

    Attributes:
        steps: optimizer steps.
        validation: frozen set, apart from test and training, that decides about fine-tuning and calibrates deviations.
        always: True to fine-tune whatever int8 costs, since it also continues the training.
        learning_rate: highest of the one cycle. In 3000 steps the bundled four-tap network gains .2 dB in int8 and
            .14 in float, which leaves no loss by quantisation (docs/decisions.md).
        batch: windows in a batch.
        seed: of the draws.
    """

    steps: int
    validation: FrozenSet
    always: bool = False
    learning_rate: float = 2e-4
    batch: int = 64
    seed: int = 1

    def recipe(self, taps: int) -> Recipe:
        """Return the recipe for fine-tuning a network of `taps` taps."""
        return Recipe(self.steps, self.batch, self.learning_rate, given=given_taps(taps))

    def sha256(self, training_sha256: str, data_sha256: str, *, every: bool) -> str:
        """Return the hash of all settings that determine the weights of a trained and then fine-tuned network."""
        own = [self.steps, self.learning_rate, self.batch, self.seed, every, self.validation.sha256()]
        return hashlib.sha256(json.dumps([training_sha256, data_sha256, *own]).encode()).hexdigest()


def fine_tuned(
    net: PatternNet,
    model: onnx.ModelProto,
    quantised_model: onnx.ModelProto,
    sequences: Sequences | PressSet,
    recipe: Recipe,
    seed: int = 1,
) -> PatternNet:
    """Return a copy of a network, trained further while its convolutions are rounded as in int8.

    Ranges of values stay those of the quantised graph; scales of weights follow the weights. The result has plain
    weights, to be exported and quantised again with ranges measured again, and then `recalibrated`.

    Args:
        net: without batch normalisation, see `export.quantisation.rounding.folded`.
        model: its graph in float.
        quantised_model: its graph in int8.
        sequences: training taps, of at least as many taps as it takes.
        recipe: hyperparameters.
        seed: of the draws.

    Raises:
        ExportError: the graph has convolutions that the network lacks.
        DatasetError: the sequences have fewer taps than the network takes.
        DivergedError: the learning rate is too high.
    """
    trained = copy.deepcopy(net)
    objective = HeteroscedasticError() if isinstance(trained, CompactNet) else RelativeError()
    batches = batches_of(sequences, net.scale, recipe, seed, posed=net.takes_poses)
    with contextlib.ExitStack() as done:
        done.enter_context(rounded(trained, integer_convolutions(model, quantised_model)))
        folder = done.enter_context(tempfile.TemporaryDirectory())
        train(trained, objective, batches, recipe, Path(folder) / "fine-tune.resume")
        trained.cpu()
    plain = copy.deepcopy(net)
    plain.load_state_dict(trained.state_dict())
    return plain.eval()


def recalibrated(net: PatternNet, integers: onnx.ModelProto, validation: FrozenSet) -> PatternNet:
    """Return a copy whose deviations, if it has any, are calibrated to the errors of its quantised graph.

    The deviations of the float network do not fit: a background that is flat in float is cut to whole steps in int8.

    Args:
        net: network with the same weights, in float.
        integers: its quantised graph.
        validation: of the network's scale.
    """
    other = copy.deepcopy(net)
    if isinstance(other, CompactNet):
        patterns, deviations = GraphRun(integers)(network_input(validation.windows(net.taps)).numpy())[:2]
        other.deviation_scale *= calibrate(validation.patterns(), patterns, deviations)
    return other


@dataclass(frozen=True, slots=True)
class Quantised:
    """Quantised network, with the float network of the same weights.

    Attributes:
        net: network with the same weights, in float.
        model: its graph in float.
        integers: its graph in int8.
        trained_on: True if the weights were fine-tuned.
        said: summary of the fine-tuning and its gain; empty without fine-tuning.
    """

    net: PatternNet
    model: onnx.ModelProto
    integers: onnx.ModelProto
    trained_on: bool = False
    said: str = ""


def quantised_well(
    net: PatternNet,
    model: onnx.ModelProto,
    geometry: SensorGeometry,
    seen: Batch,
    sequences: Sequences | PressSet,
    tuning: FineTuning | None,
    most_loss_db: float,
    *,
    every: bool = False,
    beyond: NDArray[np.float32] | None = None,
) -> Quantised:
    """Quantise a network; fine-tune it where int8 costs more than `most_loss_db` in validation, or always.

    Weights that are not better after fine-tuning are discarded.

    Args:
        net: without batch normalisation, see `export.quantisation.rounding.folded`.
        model: its graph in float.
        geometry: of the sensor.
        seen: of which ranges are taken, see `export.quantisation.int8.quantised`.
        sequences: training taps.
        tuning: settings of the fine-tuning, or None for no fine-tuning.
        most_loss_db: largest accepted loss by int8, in [dB].
        every: quantise all convolutions.
        beyond: windows that widen the ranges, see `export.quantisation.int8.quantised`.

    Raises:
        ExportError: no node of the graph can be quantised.
        DivergedError: the learning rate is too high.
    """
    length = model.graph.input[0].type.tensor_type.shape.dim[0]
    batch = length.dim_param or length.dim_value
    plain = Quantised(net, model, quantised(model, seen, every=every, beyond=beyond))
    if tuning is None:
        return plain
    validation = tuning.validation
    in_float_db = graph_psnr_db(model, net.taps, validation)
    before_db = in_float_db - graph_psnr_db(plain.integers, net.taps, validation)
    if before_db <= most_loss_db and not tuning.always:
        return plain
    recipe = tuning.recipe(net.taps)
    other = fine_tuned(net, model, plain.integers, sequences, recipe, tuning.seed)
    integers = quantised(to_model(other, geometry, batch), seen, every=every, beyond=beyond)
    now_db = in_float_db - graph_psnr_db(integers, net.taps, validation)
    comparison = f"fine-tuned {tuning.steps} steps: before {before_db:.3f} dB lost in validation, now {now_db:.3f}"
    if now_db >= before_db:
        return replace(plain, said=f"{comparison}, so not used")
    other = recalibrated(other, integers, validation)
    model = to_model(other, geometry, batch)
    return Quantised(other, model, quantised(model, seen, every=every, beyond=beyond), trained_on=True, said=comparison)


def graph_psnr_db(model: onnx.ModelProto, taps: int, validation: FrozenSet) -> float:
    """Return the mean PSNR of a graph's patterns on a frozen set of its scale, in [dB]."""
    patterns = GraphRun(model)(network_input(validation.windows(taps)).numpy())[0]
    return float(np.mean(psnr_db(patterns, validation.patterns(), validation.full_scale_mm)))
