"""The keys that do the same wherever one is in the Inspect step, in words, for every list of keys that is shown."""

from __future__ import annotations

KEYS: tuple[tuple[str, str], ...] = (
    ("Space", "Accept the tree, and go to the next one, the worst first"),
    ("L", "Look again later, and go to the next one"),
    ("Ctrl, Shift + click", "In the table: choose several trees"),
    ("Ctrl+Z, Ctrl+Shift+Z", "Undo, redo"),
    ("N  P", "Next, previous tree"),
    ("F  T  H", "Look at the tree, from the top, at the whole plot"),
    ("C", "Next colours"),
)
