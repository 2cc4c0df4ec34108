"""The demonstration: a synthetic patient is made, written to disk, and run as any other scene."""

from __future__ import annotations

from pathlib import Path

from guidance.phantom import Phantom, make_phantom

_STRUCTURES: dict[str, dict[str, str | int | float | bool]] = {
    "skin": {"role": "entry", "max_parameters": 200},
    "ribs": {"role": "avoid", "margin_mm": 2.0, "retain": True},
    "liver": {"role": "pass", "max_parameters": 600},
    "hepatic veins": {"role": "avoid", "margin_mm": 3.0, "retain": True},
    "portal vein": {"role": "avoid", "margin_mm": 3.0, "retain": True},
    "gallbladder": {"role": "avoid", "margin_mm": 3.0, "max_parameters": 150},
    "tumour": {"role": "target", "max_parameters": 60},
}
_ENTRY_REGION_MM = 110.0


def write_demo(folder: Path, seed: int) -> Path:
    """Make the synthetic patient of a seed; write meshes, label map and `scene.toml` there; return the scene's path."""
    phantom = make_phantom(seed)
    files = phantom.save(folder)
    scene = folder / "scene.toml"
    scene.write_text(_scene_text(phantom, files, seed), encoding="utf-8")
    return scene


def _scene_text(phantom: Phantom, files: dict[str, Path], seed: int) -> str:
    x, y, z = (round(float(v), 3) for v in phantom.tumour)
    lines = [
        f"# A synthetic patient, seed {seed}: made by code, nobody's anatomy. LPS, mm.",
        f'name = "synthetic liver, seed {seed}"',
        "",
        "[needle]",
        "length_mm = 150",
        "radius_mm = 0.9",
        "",
        "[errors]",
        "registration_mm = 1.0",
        "tracker_mm = 0.3",
        "bending_mm = 0.5",
        'fit = "max"',
        "",
        "[target]",
        'structure = "tumour"',
        "tolerance_mm = 3",
        "",
        "[entry]",
        'structure = "skin"',
        "count = 4000",
        f"near = [{x}, {y}, {z}]",
        f"within_mm = {_ENTRY_REGION_MM}",
        "max_angle_deg = 60",
    ]
    for name, options in _STRUCTURES.items():
        lines += ["", "[[structure]]", f'name = "{name}"', f'mesh = "{files[name].name}"', 'frame = "LPS"']
        lines += [f"{key} = {_toml(value)}" for key, value in options.items()]
    return "\n".join(lines) + "\n"


def _toml(value: str | float | bool) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else str(value)
