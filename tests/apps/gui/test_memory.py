"""A closed page is freed completely."""

from __future__ import annotations

import asyncio
import gc
import weakref
from pathlib import Path

import pytest

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

from nicegui import core
from nicegui.client import Client
from nicegui.page import page

from skysim.apps.gui.page.tab import Tab


class Hand:
    """Substitute for a worker process."""

    def close(self) -> None:
        """End."""


def test_a_closed_page_is_freed(tmp_path: Path) -> None:
    """This includes its upload area, whose route FastAPI keeps."""

    async def story() -> weakref.ref[Tab]:
        core.loop = asyncio.get_running_loop()
        client = Client(page("/"))
        with client:
            tab = Tab("shefex2", tmp_path, tmp_path)
            await tab.build()
        tab.session = Hand()  # type: ignore[assignment]
        client.on_delete(tab.close)
        freed = weakref.ref(tab)
        del tab
        client.delete()
        await asyncio.sleep(0.3)
        return freed

    freed = asyncio.run(story())
    gc.collect()
    assert freed() is None
