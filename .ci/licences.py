"""List what an installation of csgm_ros is made of: every package of its environment, with version and licence.

usage: licences.py [--json]    the latter as a CycloneDX 1.5 bill of materials
"""

import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path

ROOT = Path(__file__).parents[1]
TEXTS = {  # what only the text of that licence says
    'Apache-2.0': ('Apache License', 'Version 2.0, January 2004'),
    'MIT': ('Permission is hereby granted, free of charge, to any person obtaining a copy', 'THE SOFTWARE IS PROVIDED'),
}
BUNDLED = sorted((ROOT / 'csgm_ros').rglob('LICENSE'))  # what others wrote and this repository carries


def names() -> list[str]:
    """Return the packages of requirements.lock that this Python installs."""
    lines = (ROOT / 'requirements.lock').read_text().splitlines()
    return sorted({match[1] for line in lines if (match := re.match(r'([A-Za-z0-9][\w.-]*)==', line))}, key=str.lower)


def licence(package: Distribution) -> str:
    """Return the licence as the package states it, in one line."""
    facts = package.metadata
    classified = [text.rpartition(' :: ')[2] for text in facts.get_all('Classifier', []) if text.startswith('License')]
    manifest = Path(sys.prefix, 'share', re.sub('^ros-(jazzy-)?', '', package.name).replace('-', '_'), 'package.xml')
    if manifest.is_file():  # the wheels of ROS packages state it there alone
        classified += [element.text for element in ElementTree.parse(manifest).iter('license')]
    stated = facts.get('License-Expression') or ', '.join(classified) or facts.get('License')
    return (stated or from_text(package)).strip().splitlines()[0][:80]


def from_text(package: Distribution) -> str:
    """Return which licence a package ships that names none."""
    for name in package.metadata.get_all('License-File', []):
        text = package.read_text(f'licenses/{name}') or package.read_text(name) or ''
        text = ' '.join(text.split())
        for known, phrases in TEXTS.items():
            if all(phrase in text for phrase in phrases):
                return known
    return 'not stated'


def main() -> None:
    """Print the list."""
    found = []
    for name in names():
        try:
            package = distribution(name)
        except PackageNotFoundError:
            continue  # for the other Python
        found.append((name, package.version, licence(package)))
    if '--json' not in sys.argv:
        for row in found:
            print('{:45} {:18} {}'.format(*row))
        for path in BUNDLED:
            print(f'{path.parent.relative_to(ROOT)!s:64} {path.read_text().strip().splitlines()[0]}')
        return
    components = [
        {
            'type': 'library',
            'name': name,
            'version': number,
            'purl': f'pkg:pypi/{name.lower()}@{number}',
            'licenses': [{'license': {'name': stated}}],
        }
        for name, number, stated in found
    ]
    root = {'type': 'application', 'name': 'csgm_ros', 'version': version('csgm_ros')}
    bill = {'bomFormat': 'CycloneDX', 'specVersion': '1.5', 'version': 1, 'metadata': {'component': root}}
    print(json.dumps({**bill, 'components': components}, indent=1))


main()
