"""The blocks of code in the pages of docs."""

import re
import runpy
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page, language):
    """Return the blocks of a page, such as gym, that are in a language."""
    text = (DOCS / f"{page}.md").read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def run_page(page, folder):
    """Run the Python blocks of a page as one program; return it."""
    program = folder / "page.py"
    program.write_text(code := "\n".join(blocks(page, "python")))
    runpy.run_path(str(program))
    return code
