"""The pictures of the README, out of the executed notebooks and the measured pages.

python docs/gallery.py
"""

import base64
import json
import shutil
from pathlib import Path

ROOT = Path(__file__).parent.parent
FOLDER = Path(__file__).parent / "_static" / "gallery"
OF_NOTEBOOKS = {
    "scan": ("02_scan_gamma", 0),
    "suspension": ("04_colloids", 0),
    "contacts": ("04_colloids", 4),
    "marble": ("05_marble", 0),
}
"""By name the notebook, and which of its pictures."""


def pictures(notebook: str) -> list[bytes]:
    cells = json.loads((ROOT / "notebooks" / f"{notebook}.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", ())]
    found = [output.get("data", {}).get("image/png") for output in outputs]
    return [base64.b64decode("".join(picture)) for picture in found if picture]


if __name__ == "__main__":
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, (notebook, which) in OF_NOTEBOOKS.items():
        (FOLDER / f"{name}.png").write_bytes(pictures(notebook)[which])
    shutil.copy(ROOT / "tests" / "physics" / "bilayer.png", FOLDER)
