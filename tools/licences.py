"""Tell the licence of everything that Scanweave runs with, as a table or as a bill of materials (CycloneDX).

    python tools/licences.py                       # what `pip install scanweave` brings
    python tools/licences.py --extra view --extra compare
    python tools/licences.py --sbom > sbom.json    # CycloneDX 1.6

It reads what the packages installed here say of themselves.
"""

from __future__ import annotations

import json
import re
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


@dataclass(frozen=True, slots=True, order=True)
class Package:
    """An installed package, and the licence that it names; empty where it names none."""

    name: str
    version: str
    licence: str


def needed_by(name: str, extras: Iterable[str] = ()) -> list[Package]:
    """What a package and those that it brings want to run with, as far as it is installed, by name."""
    found: dict[str, Package] = {}
    seen: set[tuple[str, frozenset[str]]] = set()
    waiting = [(name, frozenset(extras))]
    while waiting:
        one = waiting.pop()
        if one in seen:
            continue
        seen.add(one)
        try:
            package = distribution(one[0])
        except PackageNotFoundError:
            continue
        if one[0] != name:
            found[one[0]] = Package(one[0], package.version, licence_of(package))
        for line in package.requires or ():
            wanted = Requirement(line)
            marker = wanted.marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in (one[1] or {""})):
                waiting.append((canonicalize_name(wanted.name), frozenset(wanted.extras)))
    return sorted(found.values())


def licence_of(package: Distribution) -> str:
    """What a package says: an SPDX expression, else its classifiers, else the first line of its text."""
    metadata = package.metadata
    if expression := metadata.get("License-Expression"):
        return str(expression)
    classes = [
        line.rsplit(" :: ", 1)[-1] for line in metadata.get_all("Classifier") or () if "License ::" in line
    ]
    named = [line for line in classes if line != "OSI Approved"]
    return ", ".join(named) or (metadata.get("License") or "").strip().partition("\n")[0]


def forbidden(licence: str) -> bool:
    """Whether a licence is the GPL or AGPL with no other to choose.

    The LGPL is none of them, nor is the library that GCC puts into what it compiles, by its exception.
    """
    choices = re.split(r"\bOR\b", re.sub(r"\S*GPL\S* WITH GCC-exception\S*", "", licence))
    gnu = re.compile(r"\bA?GPL|(?<!Lesser )(?<!Library or Lesser )General Public License")
    return bool(licence) and all(gnu.search(choice) for choice in choices)


def bill_of_materials(packages: Iterable[Package]) -> dict[str, object]:
    """The packages as CycloneDX 1.6 has them."""
    parts = [
        {
            "type": "library",
            "name": one.name,
            "version": one.version,
            "purl": f"pkg:pypi/{one.name}@{one.version}",
            **({"licenses": [{"license": {"name": one.licence}}]} if one.licence else {}),
        }
        for one in packages
    ]
    return {"bomFormat": "CycloneDX", "specVersion": "1.6", "version": 1, "components": parts}


def main() -> None:
    """Print what is asked for."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawDescriptionHelpFormatter)
    parser.add_argument(
        "--extra", action="append", default=[], help="with what this extra brings; repeatable"
    )
    parser.add_argument("--sbom", action="store_true", help="a bill of materials instead of a table")
    given = parser.parse_args()
    packages = needed_by("scanweave", given.extra)
    if given.sbom:
        print(json.dumps(bill_of_materials(packages), indent=2))
        return
    for one in packages:
        print(f"{one.name:30} {one.version:16} {one.licence or 'names none'}")


if __name__ == "__main__":
    main()
