"""States of checkpoints, leaf by leaf."""

from __future__ import annotations

from typing import Any


def leaves(values: Any, name: str = "") -> dict[str, Any]:
    """Every tensor and plain value of nested containers by its path."""
    if isinstance(values, dict):
        return {path: leaf for key, value in values.items() for path, leaf in leaves(value, f"{name}/{key}").items()}
    if isinstance(values, (list, tuple)):
        return {
            path: leaf for index, value in enumerate(values) for path, leaf in leaves(value, f"{name}/{index}").items()
        }
    return {name: values}
