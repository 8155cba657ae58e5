"""Draw the README's pictures again: ``python docs/make_images.py`` (half a minute).

The figures of the joint scenario, reduced to 1200 pixels and 96 colours, which keeps each of them
below 300 kB.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from scenarios import registry

PICTURES = {"fig21_speed_power": "joint_speed_power", "fig24_currents": "joint_currents"}
WIDTH = 1200  # px


def main() -> None:
    """Run the scenario and write ``docs/images``."""
    folder = Path(__file__).parent / "images"
    folder.mkdir(exist_ok=True)
    with TemporaryDirectory() as out:
        registry.run("joint", out=out)
        for figure, name in PICTURES.items():
            full = Image.open(Path(out) / f"{figure}.png").convert("RGB")
            small = full.resize((WIDTH, round(full.height * WIDTH / full.width)), Image.LANCZOS)
            small = small.quantize(96, dither=Image.Dither.NONE)
            small.save(folder / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
