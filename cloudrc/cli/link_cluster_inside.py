"""A change of the link goes into a pod's link container; what that tells of itself comes out.

What is done inside is a few lines of `sh`, which every image has: two Pythons that start in pods
at once take as long as all else of `cloudrc link set`, 0.5 s where a processor is slow.
"""

from __future__ import annotations

from cloudrc.cluster.link import Place
from cloudrc.cluster.tools import run
from cloudrc.link.sidecar_handed import HANDED_FILE, Handed, write_handed
from cloudrc.link.state import STATE_FILE, read_change

FOLDER = "/run/cloudrc"
"""In a link container: where the chart lets route, state and what is handed over lie."""
PATIENCE = 5.0
"""For the sidecar to take a change over [s]; it takes 0.2."""
HAND_LIMIT = 25.0
"""For a container to take a change over and tell of it [s]."""
_LOOK_PERIOD = 0.02
INSIDE = f"""\
cd "$1" 2>/dev/null && test -f {STATE_FILE} || {{
    echo 'error: no link is shaped here;' >&2; exit 2; }}
draft=.{HANDED_FILE}.$$
cat > $draft && test "$(wc -c < $draft)" -eq "$3" && mv $draft {HANDED_FILE} || {{
    rm -f $draft; echo 'error: the change did not arrive whole;' >&2; exit 2; }}
for _ in $(seq {round(PATIENCE / _LOOK_PERIOD)}); do
    grep -qF "\\"$2\\"" {STATE_FILE} && break
    sleep {_LOOK_PERIOD}
done
cat {STATE_FILE}
"""
"""For `sh`, with folder, number of the change and length of the document, which it reads: leaves it
where the sidecar looks, in one step, and tells what holds once the sidecar has decided."""


def hand_over(place: Place, pod: str, handed: Handed) -> str:
    """Hand a change to a pod's link container, and wait until it has decided.

    Args:
        place: Of the release.
        pod: Its name.
        handed: The change.

    Returns:
        What the link tells of itself then, as JSON.

    Raises:
        ClusterError: If kubectl or the container refuses.
    """
    document, number = write_handed(handed), read_change(handed.change).number
    words = ["sh", "-c", INSIDE, "sh", FOLDER, number, str(len(document.encode()))]
    command = [*place.flags, "exec", "--stdin", pod, "--container=link", "--", *words]
    return run("kubectl", command, timeout=HAND_LIMIT, given=document)
