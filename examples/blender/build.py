"""Build the zip of the Blender extension: python examples/blender/build.py -o FOLDER (``make blender-addon``).

Equal files make equal zips, byte by byte.
"""

import argparse
import tomllib
import zipfile
from pathlib import Path

SOURCE = Path(__file__).parent / "jaxdn_denoise"


def build(out: Path) -> Path:
    """Write ``ID-VERSION.zip`` of the manifest into a folder, and return its path."""
    manifest = tomllib.loads((SOURCE / "blender_manifest.toml").read_text("utf-8"))
    out.mkdir(parents=True, exist_ok=True)
    target = out / f"{manifest['id']}-{manifest['version']}.zip"
    part = target.with_name(f".{target.name}.part")
    with zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(SOURCE.iterdir()):
            if path.suffix in (".py", ".toml"):
                entry = zipfile.ZipInfo(path.name)
                entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
                archive.writestr(entry, path.read_bytes())
    part.replace(target)
    return target


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Build the zip of the Blender extension.")
    parser.add_argument("-o", "--out", type=Path, default=Path("dist"), help="folder for the zip")
    print(build(parser.parse_args().out))
