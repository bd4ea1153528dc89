"""Several processes that serve one address, each with next to nothing: they tell who answers, and hold visitors."""

import asyncio
import os
import signal
import sys
import time
from contextlib import suppress

from dt_viz.serving import supervisor
from dt_viz.serving.board import Share
from dt_viz.serving.supervisor import HandedOver, Supervisor, listen

RECENT = 0.2  # time for which a connection that was handed over counts, seconds


def main(kind: str = "", silence: str = "10") -> int:
    """Serve until SIGTERM; `kind` is what goes wrong."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)

    def work(share: Share, listening: HandedOver) -> int:
        if kind == "fails":
            return 3
        if kind == "slow":
            time.sleep(3 * float(silence))
        if kind == "stubborn":
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
        asyncio.run(serve(share, listening))
        return 0

    if kind == "signalled":
        os.register_at_fork(after_in_parent=lambda: os.kill(os.getpid(), signal.SIGTERM))
    listening = listen("127.0.0.1", 0)

    def ready() -> None:
        print(listening.getsockname()[1], flush=True)

    supervisor.SILENCE, supervisor.RECENT = float(silence), RECENT
    try:
        return Supervisor(listening, Share(2, 100), work, ready).run()
    except KeyboardInterrupt:
        return 0


async def serve(share: Share, listening: HandedOver) -> None:
    """Answer each request with the process' number; one that asks for an upgrade is held until its client leaves."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await reader.readuntil(b"\r\n\r\n")
        await asyncio.sleep(0.05)
        held = share.connect("somebody") if b"Upgrade" in request else None
        writer.write(f"{os.getpid()} {writer.get_extra_info('peername')[0]}\n".encode())
        with suppress(ConnectionError):
            await writer.drain()
            if held is not None:
                await reader.read()
        if held is not None:
            share.disconnect(held)
        writer.close()

    server = await asyncio.start_server(answer, sock=listening)
    async with server:
        while True:
            share.beat()
            await asyncio.sleep(0.05)


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
