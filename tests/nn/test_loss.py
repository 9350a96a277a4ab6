from __future__ import annotations

import numpy as np
import pytest
import torch

from bask_data.nn.loss import (
    TINY,
    ContrastiveSettings,
    bilinear_corners,
    contrastive,
    heat_map_entropy,
    infonce,
    squared_distance,
)
from bask_data.nn.resnet import sampled, upsampled


def random_case(seed: int = 0, scale: float = 0.7):
    rng = np.random.default_rng(seed)
    b, m, n, d = 2, 3, 5, 4
    a, p = rng.normal(size=(2, b, m, d)) * scale
    others = a[:, :, None] + rng.normal(size=(b, m, n, d)) * scale
    foreground = rng.random((b, m, n)) < 0.4
    valid = rng.random((b, m, n)) < 0.8
    return a, p, others, foreground, valid


def slow_contrastive(a, p, others, foreground, valid, settings: ContrastiveSettings) -> dict[str, float]:
    """Eq. 1 in loops over pairs and pixels: the loss and the means of its terms."""
    b, m, _, d = others.shape
    root = np.sqrt(d) if settings.normalised else 1.0
    losses, matches, hinges = [], [], {True: [], False: []}
    for i in range(b):
        total, hard = 0.0, []
        for j in range(m):
            squared = sum((a[i, j, c] - p[i, j, c]) ** 2 for c in range(d))
            matches.append(squared / root if settings.match_root else squared / root**2)
            total += matches[-1] / m
            own = []
            for k in np.flatnonzero(valid[i, j]):
                on_object = bool(foreground[i, j, k])
                z = np.sqrt(sum((a[i, j, c] - others[i, j, k, c]) ** 2 for c in range(d)))
                z = z / root if on_object or settings.background_normalised else z
                margin = settings.margin_foreground if on_object else settings.margin_background
                own.append(max(0, margin - z**2) if settings.form == "squared" else max(0, margin - z) ** 2)
                hinges[on_object].append(own[-1])
                hard += [own[-1]] if own[-1] > 0 else []
            total += {"mean": 1 / m, "sum": 1.0, "hard": 0.0}[settings.non_match_term] * sum(own) / max(len(own), 1)
        if settings.non_match_term == "hard":
            total += sum(hard) / max(len(hard), 1)
        losses.append(total)
    means = {"loss": np.mean(losses), "loss_match": np.mean(matches)}
    for name, some in (("foreground", hinges[True]), ("background", hinges[False])):
        means |= {f"loss_{name}": np.mean(some), f"share_inside_margin_{name}": np.mean(np.array(some) > 0)}
    return means


def means(terms) -> dict[str, float]:
    return {name: float(value) / float(count) for name, (value, count) in terms.logged.items()}


DISTANCES = {
    "normalised": {},
    "plain": {"normalised": False},
    "by the root": {"match_root": True},
    "background plain": {"background_normalised": False},
}


@pytest.mark.parametrize("form", ["squared", "plain"])
@pytest.mark.parametrize("non_match_term", ["mean", "sum", "hard"])
@pytest.mark.parametrize("distances", DISTANCES)
def test_contrastive_loss_and_all_its_terms_equal_their_formulas_in_loops(form, non_match_term, distances):
    settings = ContrastiveSettings(form=form, non_match_term=non_match_term, **DISTANCES[distances])
    case = random_case(scale=0.15 if distances == "plain" else 0.2)
    expected = slow_contrastive(*case, settings)
    assert all(expected.values()), "a term that is zero proves nothing"
    found = contrastive(*map(torch.from_numpy, case), settings)
    assert float(found.loss) == pytest.approx(expected["loss"], rel=1e-9)
    assert means(found) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("settings", [{"match_root": True}, {"background_normalised": False}])
def test_plain_distances_are_divided_by_nothing_whatever_else_is_set(settings):
    case = [torch.from_numpy(array) for array in random_case(scale=0.15)]
    plain, both = ContrastiveSettings(normalised=False), ContrastiveSettings(normalised=False, **settings)
    assert float(contrastive(*case, both).loss) == float(contrastive(*case, plain).loss)


@pytest.mark.parametrize("non_match_term", ["mean", "sum", "hard"])
def test_parts_of_a_batch_add_up_to_the_whole(non_match_term):
    case = [torch.from_numpy(array) for array in random_case()]
    settings = ContrastiveSettings(non_match_term=non_match_term)
    whole = contrastive(*case, settings)
    parts = [contrastive(*(array[i : i + 1] for array in case), settings) for i in range(2)]
    assert float(sum(part.loss for part in parts)) / 2 == pytest.approx(float(whole.loss))
    for name, value in whole.logged.items():
        torch.testing.assert_close(sum(part.logged[name] for part in parts), value)


def test_the_loss_is_zero_if_matches_agree_and_non_matches_are_beyond_the_margins():
    a = torch.zeros(1, 2, 4)
    others = torch.ones(1, 2, 3, 4)
    flags = torch.zeros(1, 2, 3, dtype=torch.bool)
    assert float(contrastive(a, a, others, flags, ~flags).loss) == 0.0


def test_background_has_the_larger_margin():
    a = torch.zeros(1, 1, 4)
    others = torch.full((1, 1, 1, 4), 0.6)  # z^2 = 0.36, between the margins
    yes = torch.ones(1, 1, 1, dtype=torch.bool)
    assert float(contrastive(a, a, others, yes, yes).loss) == 0.0
    assert float(contrastive(a, a, others, ~yes, yes).loss) == pytest.approx(0.75 - 0.36)


def test_distances_do_not_depend_on_how_often_dimensions_are_repeated():
    a, b = torch.randn(2, 7, 16)
    torch.testing.assert_close(squared_distance(a, b), squared_distance(a.repeat(1, 4), b.repeat(1, 4)))


@pytest.mark.parametrize("form", ["squared", "plain"])
def test_gradients_are_finite_if_descriptors_coincide(form):
    a = torch.zeros(1, 2, 4, requires_grad=True)
    others = torch.zeros(1, 2, 3, 4)
    flags = torch.zeros(1, 2, 3, dtype=torch.bool)
    contrastive(a, a.detach(), others, flags, ~flags, ContrastiveSettings(form=form)).loss.backward()
    assert torch.isfinite(a.grad).all()


def slow_heat_map_entropy(queries, grid, uv, alpha, spacing) -> float:
    """Cross-entropy in loops over grid points."""
    b, m, _ = queries.shape
    _, _, height, width = grid.shape
    total = 0.0
    for i in range(b):
        for j in range(m):
            z = np.zeros((height, width))
            for v in range(height):
                for u in range(width):
                    z[v, u] = np.sqrt(np.mean((queries[i, j] - grid[i, :, v, u]) ** 2) + TINY)
            logits = -alpha * z
            log_heat = logits - np.log(np.exp(logits).sum())
            u, v = (uv[i, j] + 0.5) / spacing - 0.5
            for v0 in range(height):
                for u0 in range(width):
                    weight = max(0, 1 - abs(u - u0)) * max(0, 1 - abs(v - v0))
                    total -= weight * log_heat[v0, u0] / (b * m)
    return total


def test_heat_map_entropy_equals_its_formula_in_loops():
    torch.manual_seed(0)
    queries, cells = torch.randn(2, 3, 4, dtype=torch.float64), torch.randn(2, 4, 3, 5, dtype=torch.float64)
    uv = torch.tensor([[[10.0, 5.0], [30.3, 20.9], [17.5, 11.2]], [[4.0, 4.0], [35.0, 19.0], [21.7, 12.9]]]).double()
    grid = torch.nn.functional.interpolate(cells, scale_factor=2, mode="bilinear", align_corners=False)
    expected = slow_heat_map_entropy(queries.numpy(), grid.numpy(), uv.numpy(), 4.0, 4.0)
    found = heat_map_entropy(queries, cells, uv, 4.0)
    assert found.shape == (2, 3)
    assert float(found.mean()) == pytest.approx(expected, rel=1e-6)


def test_bilinear_corners_reproduce_sampling():
    torch.manual_seed(0)
    cells, uv = torch.randn(2, 3, 6, 9), torch.rand(2, 20, 2) * torch.tensor([71.0, 47.0])
    index, weight = bilinear_corners(uv, 8.0, 6, 9)
    values = cells.flatten(2)[:, :, None].expand(-1, -1, 20, -1).gather(-1, index[:, None].expand(-1, 3, -1, -1))
    torch.testing.assert_close((values * weight[:, None]).sum(-1).transpose(1, 2), sampled(cells, uv))


def test_infonce_is_lower_for_correct_matches():
    torch.manual_seed(0)
    cells = torch.randn(1, 8, 4, 6) * 3
    uv = torch.tensor([[[11.5, 11.5], [35.5, 19.5], [27.5, 3.5]]])
    queries = sampled(cells, uv)
    permuted = queries.roll(1, dims=1)
    good = infonce(cells, cells, queries, queries, uv, uv, 4.0, 0.1)
    bad = infonce(cells, cells, queries, permuted, uv, uv, 4.0, 0.1)
    assert float(good.loss) < float(bad.loss)
    assert means(good)["loss_match"] == 0.0
    logged = means(bad)
    assert logged["loss"] == pytest.approx(float(bad.loss))
    assert logged["loss"] == pytest.approx(logged["loss_heat_map"] + 0.1 * logged["loss_match"])


def test_heat_maps_are_trained_on_up_sampled_descriptors():
    torch.manual_seed(0)
    cells = torch.randn(1, 4, 3, 5)
    index, weight = bilinear_corners(torch.tensor([[[13.0, 9.0]]]), 1.0, 24, 40)
    assert weight.max() == 1.0
    best = index[0, 0, weight[0, 0].argmax()]
    torch.testing.assert_close(
        upsampled(cells, (24, 40)).flatten(2)[0, :, best], sampled(cells, torch.tensor([[[13.0, 9.0]]]))[0, 0]
    )
