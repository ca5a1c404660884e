"""`dbh-studio models`: the trained models on this computer, how they get there, and whether they work."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dbh_studio.cli.common import path_argument, progress_for

if TYPE_CHECKING:
    from dbh_studio.io.models import ModelState, ModelStore, SelfCheck

_STATES = {
    "ready": "ready",
    "unchecked": "here, not checked yet",
    "partial": "fetched in part",
    "absent": "not here",
    "damaged": "damaged",
}
_ORIGINS = {"added": ", added by hand", "first use": ", hash taken at the first download"}


def add_commands(commands: Any) -> None:
    """Register the commands."""
    models = commands.add_parser(
        "models",
        help="trained models that find trunks in photos: list, fetch, add, verify",
        description="The trained models that find trunks in photos. The studio works without them. They are kept in "
        "the user's cache, or in the folder DBH_STUDIO_CACHE names. DBH_STUDIO_OFFLINE=1 forbids downloads.",
    )
    actions = models.add_subparsers(title="actions", metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="which models there are, their licence and size, and which are here")
    listing.set_defaults(command=list_models)

    fetch = actions.add_parser(
        "fetch",
        help="download models and check them",
        description="Download models, go on where an earlier download stopped, and check every file before it is used. "
        "Status 0 where all are here.",
    )
    fetch.add_argument("names", nargs="*", metavar="NAME", help="as `models list` names them; the usual pair without")
    fetch.add_argument("--offline", action="store_true", help="download nothing; say what would be needed")
    fetch.set_defaults(command=fetch_models)

    add = actions.add_parser(
        "add",
        help="take model files that were got by other means",
        description="Copy model files into the cache: those whose hash is in the list, or, with --as, any of the right "
        "signature.",
    )
    add.add_argument("paths", nargs="+", type=path_argument, metavar="PATH", help="files, or a folder with them")
    add.add_argument("--as", dest="name", metavar="NAME", help="the model they are, where their hash is another")
    add.add_argument("--link", action="store_true", help="link instead of copying; the files must then stay there")
    add.set_defaults(command=add_models)

    verify = actions.add_parser(
        "verify",
        help="check the files and run each model on a drawing with three trunks",
        description="Hash every file anew, compare what each graph takes and gives with the list, and run it on a "
        "drawing with three trunks. Status 0 where all models that are here pass.",
    )
    verify.add_argument(
        "names", nargs="*", metavar="NAME", help="as `models list` names them; all that are here without"
    )
    verify.add_argument(
        "--pictures", type=path_argument, metavar="FOLDER", help="save the drawings with what was found"
    )
    verify.set_defaults(command=verify_models)
    for action in (fetch, add, verify):
        action.add_argument("--quiet", action="store_true", help="no progress bar")
    for action in actions.choices.values():
        action.add_argument("--json", action="store_true", help="print JSON")
        # As behind every other command.
        action.add_argument("--verbose", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)


def list_models(options: argparse.Namespace) -> int:
    """Print every model of the list and what is here of it."""
    store = _store()
    states = store.states()
    if options.json:
        print(json.dumps({"folder": str(store.folder), "models": [_as_json(state) for state in states]}, indent=2))
        return 0
    print(f"Models in {store.folder}\n")
    for state in states:
        print("\n".join(_described(state)))
    print("\n* is fetched by `dbh-studio models fetch` without a name.")
    return 0


def fetch_models(options: argparse.Namespace) -> int:
    """Download what is missing."""
    store = _store(offline=True if options.offline else None)
    specs = store.manifest.with_needs(options.names or list(store.manifest.defaults))
    missing = [spec for spec in specs if store.state(spec.name).state != "ready"]
    if not options.json:
        for spec in missing:
            print(f"{spec.title}: {spec.size_text}, licence {spec.licence} ({spec.licence_url}), from {spec.source}")
    with progress_for(options) as progress:
        states = store.fetch(options.names, progress=progress)
    _print_states(states, options)
    if missing and not options.json:
        print("`dbh-studio models verify` tells in a minute whether they do what they should.")
    return 0


def add_models(options: argparse.Namespace) -> int:
    """Take files from the disk."""
    with progress_for(options) as progress:
        states = _store().add(options.paths, name=options.name, link=options.link, progress=progress)
    _print_states(states, options)
    return 0


def verify_models(options: argparse.Namespace) -> int:
    """Hashes, signatures and the drawing."""
    from dbh_studio.errors import ModelError

    store = _store()
    names = options.names or [state.spec.name for state in store.states() if state.state != "absent"]
    if not names:
        raise ModelError("No models are on this computer.", "`dbh-studio models fetch` fetches the usual pair.")
    for name in names:
        store.manifest.get(name)
    checks: list[SelfCheck] = []
    with progress_for(options) as progress:
        for index, name in enumerate(names):
            progress(index / len(names), f"Checking {name}")
            check = _checked(store, name, progress)
            checks.append(check)
            _save_picture(check, options.pictures)
    if options.json:
        parts = ("model", "verdict", "message", "seconds")
        print(json.dumps([{part: getattr(check, part) for part in parts} for check in checks], indent=2))
    else:
        for check in checks:
            print(f"{check.verdict:<9}{check.model}: {check.message}")
        if any(check.verdict == "doubtful" for check in checks):
            print(_DOUBTFUL)
    return 0 if all(check.verdict == "ok" for check in checks) else 1


_DOUBTFUL = (
    "\nDoubtful: the model runs, but does not find what is drawn, or finds much else. Where its files are the\n"
    "published ones, the drawing may be too plain for it: look at what it found with --pictures FOLDER, and\n"
    "try a photo. A file added by hand may be wrong."
)


def _checked(store: ModelStore, name: str, progress: Any) -> SelfCheck:
    """The files' content first, then what the model does."""
    from dbh_studio.errors import ModelError
    from dbh_studio.io.models import SelfCheck, self_check

    spec = store.manifest.get(name)
    try:
        for part in (name, *spec.needs):
            store.rehash(part, progress=progress)
        return self_check(spec, store.paths(name))
    except ModelError as error:
        return SelfCheck(name, "failed", str(error))


def _save_picture(check: SelfCheck, folder: Path | None) -> None:
    if folder is None or check.picture is None:
        return
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    Image.fromarray(check.picture).save(folder / f"{check.model}.png")


def _store(*, offline: bool | None = None) -> ModelStore:
    from dbh_studio.io.models import ModelStore

    return ModelStore(offline=offline)


def _print_states(states: tuple[ModelState, ...], options: argparse.Namespace) -> None:
    if options.json:
        print(json.dumps([_as_json(state) for state in states], indent=2))
        return
    for state in states:
        print(f"{state.spec.name}: {_STATES[state.state]}{_ORIGINS.get(state.origin, '')}")


def _described(state: ModelState) -> list[str]:
    spec = state.spec
    mark = "*" if spec.is_default else " "
    status = f"{_STATES[state.state]}{_ORIGINS.get(state.origin, '')}"
    return [
        f"{mark} {spec.name:<28}{spec.purpose:<11}{spec.size_text:>9}  {status}",
        f"    {spec.title}. {spec.note}",
        f"    {spec.licence}, {spec.licence_url}",
    ]


def _as_json(state: ModelState) -> dict[str, Any]:
    spec = state.spec
    files = [
        {
            "name": part.file.name,
            "role": part.file.role,
            "url": part.file.url,
            "bytes": part.file.n_bytes,
            "sha256": part.file.sha256,
            "signature": _signature(part.file),
            "path": str(part.path),
            "state": part.state,
            "bytes_here": part.n_bytes,
            "accepted_sha256": part.sha256,
            "accepted_by": part.origin,
        }
        for part in state.files
    ]
    texts = ("name", "title", "purpose", "family", "precision", "licence", "licence_url", "source", "revision", "note")
    described = {name: getattr(spec, name) for name in texts}
    return {**described, "needs": spec.needs, "is_default": spec.is_default, "state": state.state, "files": files}


def _signature(file: Any) -> dict[str, Any] | None:
    if file.signature is None:
        return None
    sides = {"inputs": file.signature.inputs, "outputs": file.signature.outputs}
    return {
        side: [{"name": t.name, "dtype": t.dtype, "shape": t.shape, "fixed": t.is_fixed} for t in tensors]
        for side, tensors in sides.items()
    }
