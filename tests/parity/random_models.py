"""Small models of transformers with random weights, and their exports with the signatures of the public ones.

Needs torch, transformers and onnx. The architectures are the public models'; only the sizes are smaller.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
import transformers.models.grounding_dino.modeling_grounding_dino as dino_code
from onnx import TensorProto, numpy_helper
from torch import nn
from transformers import (
    BertConfig,
    GroundingDinoConfig,
    GroundingDinoForObjectDetection,
    Sam2Config,
    Sam2Model,
    SamConfig,
    SamModel,
    SwinConfig,
)

SIDE = 128
OPSET = 17
CLS, SEP, STOP, QUESTION = 101, 102, 1012, 1029  # transformers' code has these numbers in it
WORDS = ["tree", "trunk", "pole", "person", "a", "of", "bark", "tr", "##unk", "##ee", "##s", "don", "'", "t", "-", "!"]


def write_vocabulary(path: Path) -> list[str]:
    """A vocabulary whose special pieces have BERT's numbers."""
    pieces = [f"[unused{i}]" for i in range(1100)]
    for number, piece in ((0, "[PAD]"), (100, "[UNK]"), (CLS, "[CLS]"), (SEP, "[SEP]"), (103, "[MASK]")):
        pieces[number] = piece
    pieces[STOP], pieces[QUESTION], pieces[1010] = ".", "?", ","
    letters = [chr(ord("b") + i) for i in range(25)]
    extra = [*WORDS, *letters, *(f"##{letter}" for letter in ["a", *letters])]
    extra = [piece for piece in dict.fromkeys(extra) if piece not in pieces]
    pieces[1030 : 1030 + len(extra)] = extra
    path.write_text("\n".join(pieces) + "\n", encoding="utf-8")
    return pieces


def spread(model: nn.Module, seed: int) -> None:
    """Weights far from those of a fresh model, whose heads answer the same everywhere."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, weights in model.named_parameters():
            noise = torch.randn(weights.shape, generator=generator)
            if weights.dim() > 1:
                weights.copy_(noise / weights[0].numel() ** 0.5)
            else:
                weights.copy_(0.1 * noise + (1.0 if "norm" in name and name.endswith("weight") else 0.0))


def grounding_dino() -> GroundingDinoForObjectDetection:
    backbone = SwinConfig(
        image_size=64,
        patch_size=4,
        embed_dim=12,
        depths=[1, 1, 2, 1],
        num_heads=[1, 2, 3, 4],
        window_size=7,
        out_indices=[2, 3, 4],
    )
    text = BertConfig(
        vocab_size=1100,
        hidden_size=32,
        num_hidden_layers=1,
        num_attention_heads=2,
        intermediate_size=64,
        max_position_embeddings=256,
    )
    config = GroundingDinoConfig(
        backbone_config=backbone,
        text_config=text,
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_ffn_dim=64,
        decoder_ffn_dim=64,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        num_queries=60,
        disable_custom_kernels=True,
    )
    model = GroundingDinoForObjectDetection._from_config(config, attn_implementation="eager").eval()
    spread(model, 0)
    return model


def sam() -> SamModel:
    size = {"image_size": SIDE, "patch_size": 16}
    config = SamConfig(
        vision_config=dict(
            hidden_size=24,
            output_channels=32,
            num_hidden_layers=2,
            num_attention_heads=2,
            window_size=4,
            global_attn_indexes=[1],
            mlp_dim=48,
            num_pos_feats=16,
            **size,
        ),
        prompt_encoder_config=dict(hidden_size=32, mask_input_channels=8, **size),
        mask_decoder_config=_decoder(),
    )
    model = SamModel._from_config(config, attn_implementation="eager").eval()
    spread(model, 1)
    return model


def sam2() -> Sam2Model:
    config = Sam2Config(
        vision_config=dict(
            backbone_config=dict(
                model_type="sam2_hiera_det_model",
                hidden_size=8,
                num_attention_heads=1,
                image_size=[SIDE, SIDE],
                blocks_per_stage=[1, 1, 2, 1],
                embed_dim_per_stage=[8, 16, 32, 64],
                num_attention_heads_per_stage=[1, 2, 4, 8],
                window_size_per_stage=[8, 4, 8, 4],
                global_attention_blocks=[3],
                window_positional_embedding_background_size=[7, 7],
            ),
            backbone_channel_list=[64, 32, 16, 8],
            backbone_feature_sizes=[[32, 32], [16, 16], [8, 8]],
            fpn_hidden_size=32,
        ),
        prompt_encoder_config=dict(hidden_size=32, image_size=SIDE, patch_size=16, mask_input_channels=8),
        mask_decoder_config=_decoder(),
    )
    model = Sam2Model._from_config(config, attn_implementation="eager").eval()
    spread(model, 2)
    return model


def export_grounding_dino(model: GroundingDinoForObjectDetection, path: Path) -> Path:
    class Flat(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, pixel_values: Any, input_ids: Any, token_type_ids: Any, attention_mask: Any, pixel_mask: Any):
            found = self.model(
                pixel_values=pixel_values,
                input_ids=input_ids,
                token_type_ids=token_type_ids,
                attention_mask=attention_mask,
                pixel_mask=pixel_mask,
            )
            return found.logits, found.pred_boxes

    tokens = torch.tensor([[CLS, 1030, 1031, STOP, 1032, STOP, SEP]])
    names = ["pixel_values", "input_ids", "token_type_ids", "attention_mask", "pixel_mask"]
    picture, mask = torch.randn(1, 3, SIDE, SIDE), torch.ones(1, SIDE, SIDE, dtype=torch.int64)
    original = dino_code.generate_masks_with_special_tokens_and_transfer_map
    dino_code.generate_masks_with_special_tokens_and_transfer_map = exportable_text_masks
    try:
        given = (picture, tokens, torch.zeros_like(tokens), torch.ones_like(tokens), mask)
        _export(Flat(), given, path, names, ["logits", "pred_boxes"], {name: {1: "length"} for name in names[1:4]})
    finally:
        dino_code.generate_masks_with_special_tokens_and_transfer_map = original
    graph = onnx.load(str(path))
    _without_doubles(graph.graph)
    onnx.save(graph, str(path))
    return path


def exportable_text_masks(input_ids: torch.Tensor, special_tokens: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """transformers' masks of the phrases with operators that ONNX has; a test compares the two."""
    index = torch.arange(input_ids.shape[1])
    ends = torch.zeros_like(input_ids, dtype=torch.bool)
    for token in (CLS, SEP, STOP, QUESTION):
        ends = ends | (input_ids == token)
    here, there = index.view(1, -1, 1), index.view(1, 1, -1)
    last = index.shape[0]
    before = torch.where(ends.unsqueeze(1) & (there < here), there, torch.full_like(there, -1)).amax(-1)
    after = torch.where(ends.unsqueeze(1) & (there >= here), there, torch.full_like(there, 1) * last).amin(-1)
    in_phrase = (after != 0) & (after != last - 1) & (after != last)
    together = (after.unsqueeze(2) == after.unsqueeze(1)) & in_phrase.unsqueeze(1) | (here == there)
    places = torch.where(in_phrase, index.view(1, -1) - before - 1, torch.zeros_like(after))
    return together, torch.clamp(places, min=0)


class _MetaDecoder(nn.Module):
    """The decoder of the authors' own script: labels 2 and 3 are a box's corners, and it gives four guesses or one."""

    def __init__(self, model: SamModel, one: bool) -> None:
        super().__init__()
        self.model, self.one = model, one

    def forward(self, image_embeddings, point_coords, point_labels, mask_input, has_mask_input, orig_im_size):
        prompts = self.model.prompt_encoder
        points = prompts.shared_embedding((point_coords + 0.5).unsqueeze(1), (SIDE, SIDE)).squeeze(1)
        labels = point_labels.unsqueeze(-1)
        points = points * (labels != -1) + prompts.not_a_point_embed.weight * (labels == -1)
        for i in range(4):
            points = points + prompts.point_embed[i].weight * (labels == i)
        dense = has_mask_input * prompts.mask_embed(mask_input)
        dense = dense + (1 - has_mask_input) * prompts.no_mask_embed.weight.reshape(1, -1, 1, 1)
        places = self.model.get_image_wide_positional_embeddings()
        guesses = [
            self.model.mask_decoder(
                image_embeddings=image_embeddings,
                image_positional_embeddings=places,
                sparse_prompt_embeddings=points.unsqueeze(1),
                dense_prompt_embeddings=dense,
                multimask_output=many,
            )[:2]
            for many in (False, True)
        ]
        masks = torch.cat([part[0] for part in guesses], dim=2)[:, 0]
        scores = torch.cat([part[1] for part in guesses], dim=2)[:, 0]
        if self.one:
            weight = torch.tensor([1000.0, 0.0, 0.0, 0.0])
            best = torch.argmax(scores + (point_coords.shape[1] - 2.5) * weight, dim=1)
            row = torch.arange(masks.shape[0])
            masks, scores = masks[row, best].unsqueeze(1), scores[row, best].unsqueeze(1)
        # The public graphs enlarge here too; the runtime asks for the small ones, so their size does not matter.
        return masks + 0 * orig_im_size.sum(), scores, masks


def export_sam(model: SamModel, folder: Path) -> dict[str, Path]:
    class Encoder(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, images: Any) -> Any:
            return self.model.vision_encoder(images)[0]

    picture = torch.randn(1, 3, SIDE, SIDE)
    paths = {"encoder": folder / "sam_encoder.onnx"}
    _export(Encoder(), (picture,), paths["encoder"], ["images"], ["image_embeddings"], {})
    names = ["image_embeddings", "point_coords", "point_labels", "mask_input", "has_mask_input", "orig_im_size"]
    low = SIDE // 4
    with torch.no_grad():
        given = (
            Encoder()(picture),
            torch.rand(1, 3, 2) * SIDE,
            torch.tensor([[2.0, 3.0, 1.0]]),
            torch.zeros(1, 1, low, low),
            torch.zeros(1),
            torch.tensor([60.0, 100.0]),
        )
    for kind in ("multi", "single"):
        paths[kind] = folder / f"sam_decoder_{kind}.onnx"
        outputs = ["masks", "iou_predictions", "low_res_masks"]
        lengths = {"point_coords": {1: "n"}, "point_labels": {1: "n"}}
        _export(_MetaDecoder(model, kind == "single"), given, paths[kind], names, outputs, lengths)
    return paths


def export_sam2(model: Sam2Model, folder: Path) -> dict[str, Path]:
    class Encoder(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, pixel_values: Any) -> Any:
            return tuple(self.model.get_image_embeddings(pixel_values))

    def decode(sparse: torch.Tensor, features: tuple) -> Any:
        prompts = model.prompt_encoder
        dense = prompts.no_mask_embed.weight.reshape(1, -1, 1, 1).expand(1, -1, *prompts.image_embedding_size)
        return model.mask_decoder(
            image_embeddings=features[2],
            image_positional_embeddings=model.get_image_wide_positional_embeddings(),
            sparse_prompt_embeddings=sparse,
            dense_prompt_embeddings=dense,
            multimask_output=True,
            high_resolution_features=list(features[:2]),
        )

    class Decoder(nn.Module):
        """As onnx-community's: points and boxes."""

        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, input_points: Any, input_labels: Any, input_boxes: Any, *features: Any) -> Any:
            prompts = self.model.prompt_encoder
            points = prompts._embed_points(input_points, input_labels, pad=False)
            found = decode(torch.cat([points, prompts._embed_boxes(input_boxes)], dim=2), features)
            return found[1], found[0], found[3]

    class ManyDecoder(nn.Module):
        """As samexporter's: many prompts, corners as points."""

        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, image_embed, first, second, point_coords, point_labels, mask_input, has_mask_input):
            labels = point_labels.unsqueeze(0).to(torch.int64)
            points = self.model.prompt_encoder._embed_points(point_coords.unsqueeze(0), labels, pad=True)
            found = decode(points, (first, second, image_embed))
            return found[0][0] + 0 * (mask_input.sum() + has_mask_input.sum()), found[1][0]

    picture = torch.randn(1, 3, SIDE, SIDE)
    embeddings = [f"image_embeddings.{i}" for i in range(3)]
    fine = ["high_res_feats_0", "high_res_feats_1"]
    paths = {name: folder / f"sam2_{name}.onnx" for name in ("encoder", "decoder", "xencoder", "xdecoder")}
    with torch.no_grad():
        features = Encoder()(picture)
    _export(Encoder(), (picture,), paths["encoder"], ["pixel_values"], embeddings, {})
    _export(Encoder(), (picture,), paths["xencoder"], ["image"], [*fine, "image_embed"], {})
    given = (
        torch.rand(1, 1, 2, 2) * SIDE,
        torch.ones(1, 1, 2, dtype=torch.int64),
        torch.rand(1, 1, 4) * SIDE,
        *features,
    )
    lengths = {"input_points": {2: "n"}, "input_labels": {2: "n"}}
    names = ["input_points", "input_labels", "input_boxes", *embeddings]
    outputs = ["iou_scores", "pred_masks", "object_score_logits"]
    _export(Decoder(), given, paths["decoder"], names, outputs, lengths)
    low = SIDE // 4
    given = (
        features[2],
        *features[:2],
        torch.rand(2, 3, 2) * SIDE,
        torch.tensor([[2.0, 3.0, 1.0]] * 2),
        torch.zeros(2, 1, low, low),
        torch.zeros(2),
    )
    names = ["image_embed", *fine, "point_coords", "point_labels", "mask_input", "has_mask_input"]
    lengths = {name: {0: "boxes"} for name in names[3:]}
    lengths["point_coords"][1] = lengths["point_labels"][1] = "points"
    _export(ManyDecoder(), given, paths["xdecoder"], names, ["masks", "iou_predictions"], lengths)
    return paths


def _decoder() -> dict[str, int]:
    return dict(hidden_size=32, mlp_dim=48, num_hidden_layers=2, num_attention_heads=2, iou_head_hidden_dim=32)


def _export(model: nn.Module, given: tuple, path: Path, inputs: list, outputs: list, lengths: dict) -> None:
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the tracer, whose way this export is
        torch.onnx.export(
            model.eval(),
            given,
            str(path),
            input_names=inputs,
            output_names=outputs,
            dynamic_axes=lengths,
            opset_version=OPSET,
            dynamo=False,
        )


def _without_doubles(graph: onnx.GraphProto) -> None:
    """float64 becomes float32: the tracer makes some, and onnxruntime samples no grid in float64."""
    for value in graph.initializer:
        if value.data_type == TensorProto.DOUBLE:
            value.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(value).astype("float32"), value.name))
    for node in graph.node:
        for attribute in node.attribute:
            if node.op_type == "Cast" and attribute.name == "to" and attribute.i == TensorProto.DOUBLE:
                attribute.i = TensorProto.FLOAT
            if attribute.type == onnx.AttributeProto.TENSOR and attribute.t.data_type == TensorProto.DOUBLE:
                array = numpy_helper.to_array(attribute.t).astype("float32")
                attribute.t.CopyFrom(numpy_helper.from_array(array, attribute.t.name))
            if attribute.type == onnx.AttributeProto.GRAPH:
                _without_doubles(attribute.g)
    for value in [*graph.value_info, *graph.output]:
        if value.type.tensor_type.elem_type == TensorProto.DOUBLE:
            value.type.tensor_type.elem_type = TensorProto.FLOAT
