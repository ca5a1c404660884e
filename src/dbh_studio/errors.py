"""Everything that can go wrong, as one tree.

    StudioError                     says what happened and what to do
    ├── FileError                   names the file
    │   ├── FileMissingError
    │   ├── UnsupportedFormatError  not a format the studio reads
    │   ├── MalformedFileError      the content is not what the format says
    │   │   └── TruncatedFileError  the file ends too early
    │   └── EmptyFileError          no usable points
    ├── UnscaledCloudError          lengths are in an arbitrary unit
    ├── SettingError                a setting is outside its bounds
    ├── MissingComponentError       an optional package or system library is absent
    ├── ModelError                  a trained model is absent, cannot be fetched, or is another than it should be
    ├── ProjectError                the saved plot
    │   ├── ProjectLockedError      another process is writing it
    │   ├── ProjectUnwritableError  nothing can be written in its folder
    │   ├── ProjectExistsError      there is one already, and it may hold edits
    │   ├── ProjectMismatchError    its trunks are those of another cloud
    │   └── ProjectVersionError     written by a newer program
    ├── StaleResultError            the plot changed while a job ran
    ├── AlignmentError              two clouds cannot be laid on each other
    ├── CommandError                an edit that cannot be applied
    │   └── MisfitError             some of what is brought in does not fit; the rest would
    └── CancelledError              the person pressed Cancel

Data that cannot be *measured* is not an error: it is a `core.dbh.Refusal`, a value with a reason and a remedy.
A wrong call by a programmer is a plain `ValueError`.
"""

from __future__ import annotations

from pathlib import Path


class StudioError(Exception):
    """What happened, and what the person can do about it.

    Args:
        problem: One sentence in plain words.
        remedy: What to do next; empty where there is nothing to do.
    """

    def __init__(self, problem: str, remedy: str = "") -> None:
        super().__init__(problem, remedy)
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.problem} {self.remedy}".strip()


class FileError(StudioError):
    """A problem with one file: which one, where in it, and what to do."""

    def __init__(self, path: Path | str, problem: str, remedy: str = "") -> None:
        super().__init__(problem, remedy)
        self.path = Path(path)

    def __str__(self) -> str:
        return f"{self.path.name or self.path}: {self.problem} {self.remedy}".strip()

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.path, self.problem, self.remedy)


class FileMissingError(FileError):
    """There is no such file or folder, or it may not be read."""


class UnsupportedFormatError(FileError):
    """The file is not in a format the studio reads."""


class MalformedFileError(FileError):
    """The content contradicts the format the file claims to be in."""


class TruncatedFileError(MalformedFileError):
    """The file ends before the data its header promises."""


class EmptyFileError(FileError):
    """The file is well-formed but holds no usable point."""


class UnscaledCloudError(StudioError):
    """Lengths are in an arbitrary unit, so no diameter can be given."""


class SettingError(StudioError):
    """A setting is unknown or outside its bounds."""


class MissingComponentError(StudioError):
    """An optional package or system library is absent."""


class ModelError(StudioError):
    """The files of a trained model are absent, cannot be fetched, or are not what they should be."""


class ProjectError(StudioError):
    """The saved plot cannot be read or written."""


class ProjectLockedError(ProjectError):
    """Another process is writing this plot."""


class ProjectUnwritableError(ProjectError):
    """Nothing can be written where the plot lies."""


class ProjectExistsError(ProjectError):
    """There is a saved plot where a new one was to be made."""


class ProjectMismatchError(ProjectError):
    """The saved plot was made from another cloud."""


class ProjectVersionError(ProjectError):
    """The plot was saved by a newer program."""


class StaleResultError(StudioError):
    """What a job read has changed since it started; its result was not applied."""


class AlignmentError(StudioError):
    """Two clouds of one plot cannot be laid on each other."""


class CommandError(StudioError):
    """An edit that cannot be applied to the plot as it is."""


class MisfitError(CommandError):
    """Some stems of a table do not fit the plot; they can be left out."""


class CancelledError(StudioError):
    """The person pressed Cancel; nothing was changed."""

    def __init__(self, problem: str = "Cancelled.", remedy: str = "") -> None:
        super().__init__(problem, remedy)
