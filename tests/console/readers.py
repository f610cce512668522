"""Pages that only read: `python -m tests.console.readers ADDRESS SCENE PLAIN`.

SCENE pages take the scene, PLAIN pages ask for the state once a second, as browsers do. Prints
"ready" when all pages are open.
"""

import asyncio
import sys
from urllib.parse import urlsplit

import msgspec
import viser
from viser import _messages
from websockets.asyncio.client import connect

CAMERA = msgspec.msgpack.encode(
    {
        **{"type": _messages.ViewerCameraMessage.__name__, "wxyz": (1.0, 0.0, 0.0, 0.0)},
        **{
            "position": (3.0, 3.0, 3.0),
            "look_at": (0.0, 0.0, 0.0),
            "up_direction": (0.0, 0.0, 1.0),
        },
        **{"fov": 0.9, "near": 0.01, "far": 100.0, "image_height": 800, "image_width": 1280},
    }
)
"""What viser's page sends first: from then on it is a client."""

CLOSE = "Connection: close"


async def watch_scene(address, opened):
    """Read what viser sends to a page."""
    names = [f"viser-v{viser.__version__}"]
    url = address.replace("http://", "ws://")
    async with connect(
        url, subprotocols=names, max_size=None, compression=None, proxy=None
    ) as page:
        await page.send(CAMERA)
        opened()
        async for _ in page:
            pass


async def watch_state(address, opened, delay):
    """Ask for the state once a second; the token stands in the cookie."""
    parts = urlsplit(address)
    reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
    writer.write(
        f"GET /?{parts.query} HTTP/1.1\r\nHost: {parts.netloc}\r\n{CLOSE}\r\n\r\n".encode()
    )
    head = (await reader.read()).decode()
    cookie = head.partition("set-cookie: ")[2].partition(";")[0]
    writer.close()
    opened()
    await asyncio.sleep(delay)
    while True:
        reader, writer = await asyncio.open_connection(parts.hostname, parts.port)
        lines = ["GET /state HTTP/1.1", f"Host: {parts.netloc}", f"Cookie: {cookie}", CLOSE, "", ""]
        writer.write("\r\n".join(lines).encode())
        await reader.read()
        writer.close()
        await asyncio.sleep(1.0)


async def main(address, scenes, plains):
    """Open the pages and read until the process is ended."""
    missing = scenes + plains

    def opened():
        nonlocal missing
        missing -= 1
        if not missing:
            print("ready", flush=True)

    async with asyncio.TaskGroup() as pages:
        for _ in range(scenes):
            pages.create_task(watch_scene(address, opened))
        for number in range(plains):
            pages.create_task(watch_state(address, opened, number / plains))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3])))
