#!/usr/bin/env python3
"""Prints the licences of everything that is linked into the program and the library.

The crates are those of `cargo metadata` for this machine's target, without what only builds or tests; the texts are the files
that that come with their sources, or with those of another crate of the same repository. A crate without either is named, with its
authors, and the texts of the licences that this project itself is under close the list. `tools/test` checks that all of them
are allowed (deny.toml); this only quotes them.
"""

import json
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LICENCE_FILE = re.compile(r"(licen[cs]e|copying|notice|unlicense)([-._].*)?$", re.IGNORECASE)
STANDARD = {"MIT": ROOT / "LICENSE-MIT", "Apache-2.0": ROOT / "LICENSE-APACHE"}
# Asks for no text to be passed on.
PUBLIC_DOMAIN = "CC0-1.0"


def cargo_metadata():
    host = re.search(r"^host: (.+)$", subprocess.check_output(["rustc", "-vV"], text=True), re.MULTILINE)[1]
    command = ["cargo", "metadata", "--locked", "--format-version", "1", "--filter-platform", host]
    return json.loads(subprocess.check_output(command, cwd=ROOT))


def linked_packages(metadata):
    """Packages reached from ours through normal dependencies, without ours."""
    nodes = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    ours = set(metadata["workspace_members"])
    found, waiting = set(), list(ours)
    while waiting:
        for dependency in nodes[waiting.pop()]["deps"]:
            normal = any(kind["kind"] is None for kind in dependency["dep_kinds"])
            if normal and dependency["pkg"] not in found | ours:
                found.add(dependency["pkg"])
                waiting.append(dependency["pkg"])
    packages = [package for package in metadata["packages"] if package["id"] in found]
    return sorted(packages, key=lambda package: (package["name"], package["version"]))


def texts(package):
    """Texts of the licence files beside a package's manifest."""
    directory = Path(package["manifest_path"]).parent
    files = {path for path in directory.iterdir() if path.is_file() and LICENCE_FILE.match(path.name)}
    if package["license_file"]:
        files.add(directory / package["license_file"])
    return [path.read_text(encoding="utf-8", errors="replace").strip() for path in sorted(files)]


def names_of(packages):
    return ", ".join(f"{package['name']} {package['version']}" for package in packages)


def main():
    packages = linked_packages(cargo_metadata())
    of_repository = {package["repository"]: found for package in packages if (found := texts(package))}
    by_text, bare = defaultdict(list), []
    for package in packages:
        found = texts(package) or of_repository.get(package["repository"], [])
        if not found:
            if not any(name in (package["license"] or "") for name in (*STANDARD, PUBLIC_DOMAIN)):
                sys.exit(f"{package['name']} has no file with the text of its licence, {package['license']}, "
                         "so it cannot be redistributed")
            bare.append(package)
        for text in found:
            by_text[text].append(package)
    print(f"nertca-vk contains {len(packages)} crates and Rust's standard library (MIT OR Apache-2.0).\n")
    for package in packages:
        print(f"{package['name']} {package['version']}: {package['license'] or 'see below'}; {package['repository'] or ''}")
    for text, of in sorted(by_text.items(), key=lambda item: names_of(item[1])):
        print(f"\n{'=' * 80}\n{names_of(of)}\n{'-' * 80}\n{text}")
    if bare:
        print(f"\n{'=' * 80}\nCrates without their own licence file: {names_of(bare)}; authors:")
        for package in bare:
            print(f"  {package['name']}: {', '.join(package['authors']) or 'not stated'}")
        for path in STANDARD.values():
            print(f"{'-' * 80}\n{path.read_text(encoding='utf-8').strip()}")


if __name__ == "__main__":
    main()
