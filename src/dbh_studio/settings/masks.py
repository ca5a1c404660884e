"""Settings of the masks of photos: how they are made, on what the models run, and how they vote."""

from __future__ import annotations

from typing import Literal

from dbh_studio.settings.base import SettingsModel, setting


class VoteSettings(SettingsModel):
    """How masks of photos become labels of points: who votes, what hides it, and what is enough."""

    rule: Literal["share", "count"] = setting(
        "share",
        "Rule",
        help="share: of the photos that see a point, enough call it trunk; count: the paper's label count",
    )
    min_share: float = setting(
        0.4, "Smallest share", gt=0.0, le=1.0, help="of the weighted votes; below a half, because masks miss trunks"
    )
    min_count: int = setting(2, "Fewest votes for", ge=1, le=1000, help="photos that call it trunk; the paper's is 1")
    occlusion: bool = setting(
        True, "Hidden points do not vote", help="off as in the paper: what stands behind a trunk takes its label too"
    )
    weighting: Literal["none", "distance", "incidence"] = setting(
        "none",
        "Weight of a vote",
        help="distance: near photos count more; incidence: those that look straight at it too",
    )
    weight_distance_m: float = setting(
        4.0, "Full weight up to", unit="m", ge=0.5, le=100.0, help="beyond, the weight falls with the square"
    )
    max_distance_m: float = setting(
        15.0, "Farthest point asked", unit="m", ge=1.0, le=1000.0, help="thin stems are a few pixels wide beyond it"
    )
    edge_px: int = setting(
        0, "Silent edge", unit="px", ge=0, le=50, help="a mask says nothing so near to its outline, where it bleeds"
    )
    tolerance_m: float = setting(
        0.12, "Depth tolerance", unit="m", ge=0.0, le=5.0, help="what is so little behind the nearest surface is seen"
    )
    tolerance_share: float = setting(
        0.02, "Depth tolerance, share of distance", ge=0.0, le=0.5, help="for poses and clouds that are off"
    )
    thinning_m: float = setting(
        0.02, "Voting resolution", unit="m", ge=0.002, le=0.5, help="one point per cube votes for all of its cube"
    )
    occluder_m: float = setting(
        0.04, "Hiding resolution", unit="m", ge=0.005, le=1.0, help="one point per cube hides what is behind"
    )
    depth_size_px: Literal[128, 256, 512, 1024] = setting(
        512, "Depth map", unit="px", help="pixels across a quarter of the horizon"
    )

    tell_apart: bool = setting(
        True,
        "Masks tell trunks apart",
        help="where they have numbers: a trunk with two masks in several photos is cut, fragments are joined",
    )
    second_look: bool = setting(
        True, "Look for stems by shape too", help="stems that no mask shows are offered, trunks without a stem flagged"
    )

    @classmethod
    def paper(cls) -> VoteSettings:
        """The paper's rule: every photo, nothing hides anything, a label count of one is enough."""
        return cls(
            rule="count",
            min_count=1,
            occlusion=False,
            weighting="none",
            max_distance_m=1000.0,
            edge_px=0,
            tell_apart=False,
        )


class ModelRunSettings(SettingsModel):
    """On what trained models run. None of it decides what is found, but precision and that only a little."""

    provider: Literal["auto", "cpu", "cuda", "directml", "coreml"] = setting(
        "auto", "Run on", help="auto: a graphics card where the installed onnxruntime knows it, else the processor"
    )
    precision: Literal["auto", "float32", "float16", "int8"] = setting(
        "auto", "Precision", help="float16: for graphics cards; int8: quicker, how much accuracy it costs is not known"
    )
    threads: int = setting(0, "Threads", ge=0, le=256, help="of the processor; 0: one per core")
    low_memory: bool = setting(
        True, "Save memory", help="a third less memory; off is up to a fifth quicker where there are 16 GB or more"
    )


class MaskDetectorSettings(SettingsModel):
    """How trunks are found in photos: what is looked for, in which part of the photo, and what is believed."""

    prompt: str = setting("tree trunk", "Look for", help="several things with full stops between: tree trunk. pole")
    box_threshold: float = setting(
        0.30, "Box threshold", ge=0.01, le=0.99, help="how sure the detector must be; lower finds more, and more wrong"
    )
    text_threshold: float = setting(
        0.25, "Text threshold", ge=0.01, le=0.99, help="which words of the prompt are said to be in a box"
    )
    box_overlap: float = setting(
        0.7, "Same box", ge=0.1, le=1.0, help="boxes that overlap more are one (intersection over union)"
    )
    max_box_share: float = setting(
        0.75, "Widest box", ge=0.05, le=1.0, help="share of the picture's width; a wider box is the forest, not a trunk"
    )
    min_box_px: float = setting(
        4.0, "Thinnest box", unit="px", ge=1.0, le=200.0, help="of the picture the detector looks at"
    )
    picture_shape: Literal["padded", "squashed"] = setting(
        "padded",
        "Oblong pictures",
        help="padded: shrunk to fit the detector's square; squashed: stretched over it, as the model's card does",
    )
    mask_threshold: float = setting(
        0.5, "Mask threshold", ge=0.05, le=0.95, help="probability above which a pixel is trunk"
    )
    mask_overlap: float = setting(
        0.5, "Same mask", ge=0.1, le=1.0, help="a mask of which surer ones cover more than this is left out"
    )
    panorama: Literal["tiles", "whole"] = setting(
        "tiles",
        "Panoramas",
        help="tiles: straight views all round; whole: the panorama as it is, the paper's way, where stems are thin",
    )
    tile_count: int = setting(
        5, "Tiles all round", ge=3, le=24, help="4 of 100° are quicker, 6 of 90° more thorough than 5 of 90°"
    )
    tile_fov_deg: float = setting(
        90.0, "Width of a tile", unit="°", ge=20.0, le=120.0, help="360 divided by the number of tiles, and some more"
    )
    tile_size_px: int = setting(
        1024, "Side of a tile", unit="px", ge=256, le=4096, help="the models shrink it to 800 and 1024 pixels"
    )
    tile_pitches_deg: tuple[float, ...] = setting(
        (0.0,), "Rows of tiles", unit="°", help="above the horizon: 0 for a walk, -25 too for a drone; 90 is the zenith"
    )
    mask_size_px: int = setting(
        2048, "Longest side of a mask", unit="px", ge=256, le=16384, help="masks of whole photos are no finer"
    )
