"""The losses of the presets, against transcriptions of their sources that share nothing with the package."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from bask_data.config import load_config
from bask_data.engine import resolve
from bask_data.nn.loss import contrastive
from bask_data.pipeline import STAGES
from bask_data.stages.train import _settings, train
from bask_data.stages.train_params import TrainParams

PIPELINES = Path(__file__).parents[1] / "pipelines"
N_MATCHES, N_NON_MATCHES = 6, 40


def params_of(pipeline: str) -> TrainParams:
    """The training parameters as a pipeline's file resolves them."""
    config = load_config(PIPELINES / pipeline / "params.yaml", [], STAGES)
    found = resolve(train, config, "", "main", {})
    assert isinstance(found, TrainParams)
    return found


def descriptors(dimension: int, spread: float, seed: int) -> dict[str, Any]:
    """Descriptors of a pair: of matches in both images, and of non-matches at plain distances from 0 to `spread`."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(N_MATCHES, dimension))
    away = rng.normal(size=(N_MATCHES, N_NON_MATCHES, dimension))
    away *= rng.uniform(0.0, spread, (N_MATCHES, N_NON_MATCHES, 1)) / np.linalg.norm(away, axis=-1, keepdims=True)
    return {
        "a": a,
        "b": a + rng.normal(size=a.shape) * 0.1,
        "others": a[:, None] + away,
        "on_object": rng.random((N_MATCHES, N_NON_MATCHES)) < 0.4,
    }


def squared_norm(x: np.ndarray, y: np.ndarray) -> float:
    total = 0.0
    for x_i, y_i in zip(x, y, strict=True):
        total += (float(x_i) - float(y_i)) ** 2
    return total


def paper(a, b, others, on_object) -> float:
    """von Hartz et al. 2023, Eq. 1 as printed; III-A.3: distances divided by the square root of the dimension; margins
    of the authors' code."""
    m, n, dimension = others.shape
    loss = 0.0
    for i in range(m):
        loss += (math.sqrt(squared_norm(a[i], b[i])) / math.sqrt(dimension)) ** 2 / m
        for c in range(n):
            margin = 0.25 if on_object[i, c] else 0.75
            distance = math.sqrt(squared_norm(a[i], others[i, c])) / math.sqrt(dimension)
            loss += max(0.0, margin - distance**2) / n
    return loss


def dense_object_nets(a, b, others, on_object) -> float:
    """The loss of Dense Object Nets with hard negatives: plain distances, one margin, one count."""
    m, n, _ = others.shape
    matches, hinges, n_hard = 0.0, 0.0, 0
    for i in range(m):
        matches += squared_norm(a[i], b[i])
        for c in range(n):
            hinge = max(0.0, 0.5 - math.sqrt(squared_norm(a[i], others[i, c])))
            hinges += hinge**2
            n_hard += hinge > 0
    return matches / m + hinges / max(n_hard, 1)


def authors_code(a, b, others, on_object) -> float:
    """The loss of the code of the paper's authors: the squared distances of matches over sqrt(D); those of non-matches
    on the object over sqrt(D), of others over nothing; one count of hard negatives for both."""
    m, n, dimension = others.shape
    matches, on_it, off_it, n_hard = 0.0, 0.0, 0.0, 0
    for i in range(m):
        matches += squared_norm(a[i], b[i]) / math.sqrt(dimension)
        for c in range(n):
            distance = math.sqrt(squared_norm(a[i], others[i, c]))
            if on_object[i, c]:
                hinge = max(0.0, 0.25 - distance / math.sqrt(dimension))
                on_it += hinge**2
            else:
                hinge = max(0.0, 0.75 - distance)
                off_it += hinge**2
            n_hard += hinge > 0
    return matches / m + (on_it + off_it) / max(n_hard, 1)


SOURCES = {"bask": paper, "bask-code": authors_code, "florence": dense_object_nets}


def loss_of(pipeline: str, case: dict[str, Any]) -> float:
    settings = _settings(params_of(pipeline), "cpu")
    assert settings.loss == "contrastive"
    a, b, others, on_object = (torch.from_numpy(case[name])[None] for name in ("a", "b", "others", "on_object"))
    return float(contrastive(a, b, others, on_object, torch.ones_like(on_object), settings.contrastive).loss)


@pytest.mark.parametrize("pipeline", SOURCES)
@pytest.mark.parametrize(("spread", "seed"), [(10.0, 0), (2.0, 1), (1.0, 2)])
def test_the_loss_of_a_pipeline_is_that_of_its_source(pipeline, spread, seed):
    case = descriptors(params_of(pipeline).descriptor_dim, spread, seed)
    assert loss_of(pipeline, case) == pytest.approx(SOURCES[pipeline](**case), rel=1e-6, abs=0)


@pytest.mark.parametrize("pipeline", SOURCES)
def test_the_loss_of_a_pipeline_without_hard_negatives_is_that_of_its_matches(pipeline):
    case = descriptors(params_of(pipeline).descriptor_dim, 1.0, 3)
    case["others"] = case["others"] + 100.0
    expected = SOURCES[pipeline](**case)
    assert expected > 0
    assert loss_of(pipeline, case) == pytest.approx(expected, rel=1e-6, abs=0)


def test_the_sources_differ_so_that_one_cannot_pass_for_another():
    case = descriptors(64, 2.0, 4)
    losses = [source(**case) for source in SOURCES.values()]
    assert min(abs(x - y) for i, x in enumerate(losses) for y in losses[:i]) > 0.01
