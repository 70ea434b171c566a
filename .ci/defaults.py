"""Write the defaults of csgm_ros/config.py wherever a person reads them: the YAML files and the README's table."""

import re
from pathlib import Path

from csgm_ros.config import Config, NodeConfig, flatten, profile
from csgm_ros.io.config_files import config_yaml, scalar

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Rewrite the three files in place."""
    for name, file in (('robust', 'csgm.yaml'), ('paper', 'paper.yaml')):
        (ROOT / 'config' / file).write_text(config_yaml(profile(name)))
    defaults = {**flatten(Config()), **flatten(NodeConfig())}

    def row(match: re.Match) -> str:
        name = match[1]
        return f'| `{name}` | `{scalar(defaults[name])}` |' if name in defaults else match[0]

    readme = ROOT / 'README.md'
    readme.write_text(re.sub(r'^\| `([\w.]+)` \| `[^`]*` \|', row, readme.read_text(), flags=re.MULTILINE))


main()
