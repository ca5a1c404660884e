"""Trained models: the list, the files on this computer, how they get there, and whether they do what they should."""

from __future__ import annotations

from dbh_studio.io.models.cache import InstalledFile, ModelState, is_offline, models_folder
from dbh_studio.io.models.manifest import Manifest, ModelFile, ModelSpec, Signature, Tensor, read_manifest
from dbh_studio.io.models.selfcheck import CheckPicture, SelfCheck, check_picture, self_check
from dbh_studio.io.models.signature import open_graph, signature_problems
from dbh_studio.io.models.store import ModelStore

__all__ = [
    "CheckPicture",
    "InstalledFile",
    "Manifest",
    "ModelFile",
    "ModelSpec",
    "ModelState",
    "ModelStore",
    "SelfCheck",
    "Signature",
    "Tensor",
    "check_picture",
    "is_offline",
    "models_folder",
    "open_graph",
    "read_manifest",
    "self_check",
    "signature_problems",
]
