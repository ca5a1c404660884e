"""Lens models: `lenses` holds the formulas, `inverse` turns them round."""
