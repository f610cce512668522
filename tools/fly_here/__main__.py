# SPDX-License-Identifier: Apache-2.0

"""Make the page "fly it here", one file that needs no network: `python -m tools.fly_here FILE`.

`make site` puts it into the site, in the place of the page that docs/fly-here.md gives.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tools.fly_here.flights import RECIPES, document
from tools.fly_here.page import write

if __name__ == "__main__":
    write(Path(sys.argv[1]), document(RECIPES))
