"""`asyncio.timeout`, also for Python 3.10, which lacks it."""

import asyncio
import sys

if sys.version_info >= (3, 11):
    timeout = asyncio.timeout
else:
    import contextlib
    from collections.abc import AsyncIterator

    @contextlib.asynccontextmanager
    async def timeout(delay: float) -> AsyncIterator[None]:
        """Cancel the block after `delay` seconds, and raise TimeoutError.

        If somebody else cancels the task at the same time, that is lost.
        """
        task, late = asyncio.current_task(), False
        assert task is not None

        def end() -> None:
            nonlocal late
            late = True
            task.cancel()

        timer = asyncio.get_running_loop().call_later(delay, end)
        try:
            yield
        except asyncio.CancelledError:
            if late:
                raise TimeoutError from None
            raise
        finally:
            timer.cancel()
