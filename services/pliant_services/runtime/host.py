"""Runs one service in this process: connects the bus, hands it its inputs, closes in order."""

import contextlib
import ctypes
import gc
import importlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pliant.bus.base import Window
from pliant.bus.checkpoints import Checkpoints
from pliant.bus.session import Identity, open_session
from pliant.bus.zenoh_bus import ZenohBus
from pliant.config import Config
from pliant.errors import SourceLostError
from pliant.messages import topics
from pliant_services import processes
from pliant_services.runtime.limits import check_limits
from pliant_services.runtime.monitor import StatusMonitor

_GRACE_S = 3.0
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # of malloc.h
_KEPT_BLOCK = 32 << 20
"""The largest block that malloc itself looks after, and that it can be told to, bytes."""
_KEPT = 256 << 20
"""Free memory at the end of the heap that is kept, bytes."""
_LOADED_OBJECTS = 50_000
"""New objects before garbage is looked for while modules and kernels are loaded, all of which stay:
a tenth of the time that it takes."""
_TOLD_MESSAGES = 128  # two seconds at 60 frames/s, and a few


@dataclass(frozen=True, kw_only=True)
class ServiceOptions:
    """Options of a service besides its configuration.

    endpoints: where the router listens.      session: keeps runs on one network apart.
    fleet: the services of this session.      arguments: further arguments of this service's
    ``run``.     delays_ms: largest random delay of each message, for tests. patience_s: how long
    peers may be away; the configuration's if None. state: folder of the session's checkpoints,
    where services are started again; else None. identity: the service's certificate, for endpoints
    such as tls/host:7447. alive: file that is touched once a second as long as the service is well.
    """

    endpoints: Sequence[str]
    session: str
    fleet: Sequence[str]
    arguments: Mapping[str, Any]
    delays_ms: float = 0.0
    patience_s: float | None = None
    state: Path | None = None
    identity: Identity | None = None
    alive: Path | None = None


def run_service(name: str, config: Config, options: ServiceOptions) -> None:
    """Run a service until its inputs end (a source: until it ends or is told to stop).

    Raises SourceLostError, after everything before has been sent, for a source that failed.
    """
    process = processes.BY_NAME[name]
    check_limits()
    _keep_freed_memory()
    collected_after = gc.get_threshold()
    gc.set_threshold(_LOADED_OBJECTS)
    module = importlib.import_module(process.module)
    arguments = dict(options.arguments)
    if not process.inputs and not process.observer:
        interrupted = stop_on_signal()
    else:
        # Also where a shell has SIGINT ignored: by it the launcher stops a service.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        interrupted = None
    open_session(
        options.endpoints, options.identity
    ).close()  # said now, not after a minute of compiling
    load_kernels(name)
    gc.freeze()
    gc.set_threshold(*collected_after)
    os.nice(process.niceness)
    lost: SourceLostError | None = None
    images = config.recorder.images
    restartable = options.state is not None
    checkpoints = None
    if options.state is not None and not process.observer:
        interval = config.bus.checkpoint_frames
        checkpoints = Checkpoints(options.state / name, interval=interval)
    if process.observer:
        arguments["restartable"] = restartable
    with ZenohBus(
        endpoints=options.endpoints,
        session=options.session,
        service=name,
        inputs=processes.inputs_of(name, options.fleet, images=images),
        outputs=processes.readers_of(name, options.fleet, images=images),
        window=config.bus.window,
        window_bytes=config.bus.window_mib << 20,
        patience_s=config.bus.patience_s if options.patience_s is None else options.patience_s,
        checkpoints=checkpoints,
        keeps_books=process.observer and restartable,
        stays=process.observer,
        windows={
            **observer_windows(config, options.fleet),
            **(checkpoint_windows(config, options.fleet) if restartable else {}),
        },
        lags=lags(config, options.fleet),
        packed=topics.WITH_PIXELS if config.bus.link_images != "raw" else (),
        disturb=random_delays(options.delays_ms),
        identity=options.identity,
        on_fault=lambda line: print(line, file=sys.stderr, flush=True),
        on_tick=options.alive.touch if options.alive is not None else None,
        interrupted=interrupted,
    ) as bus:
        if interrupted is not None:
            arguments["stopping"] = lambda: interrupted() or bus.stop_requested
        try:
            if process.observer:
                module.run(bus, config, **arguments)
            else:
                module.run(bus, config, StatusMonitor(bus, name), **arguments)
        except SourceLostError as error:
            lost = error
        stopping: Callable[[], bool] | None = arguments.get("stopping")
        bus.end_all(complete=lost is None and (stopping is None or not stopping()))
        bus.see_off()
    if lost is not None:
        raise lost


@cache
def load_kernels(name: str) -> None:
    """Load the module of a service and its compiled kernels, or compile them; a fork of this
    process has them."""
    process = processes.BY_NAME[name]
    module = importlib.import_module(process.module)
    if process.kernels:
        module.warm_up()


def _keep_freed_memory() -> None:
    """Have malloc keep what is freed: each frame needs as much as the last one, and pages that come
    from the system again are cleared again, which costs a twentieth of all CPU time.  In one place:
    threads that receive messages would keep as much each.

    Does nothing where malloc is not glibc's.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_MMAP_THRESHOLD, _KEPT_BLOCK)
        mallopt(_M_TRIM_THRESHOLD, _KEPT)
        mallopt(_M_ARENA_MAX, 1)


def observer_windows(config: Config, fleet: Sequence[str]) -> dict[str, Window]:
    """The windows of those services that acknowledge only what is on the disk."""
    limits = config.recorder
    window = Window(limits.window_messages, limits.window_mib << 20)
    return {name: window for name in fleet if processes.BY_NAME[name].observer}


def lags(config: Config, fleet: Sequence[str]) -> dict[str, Window]:
    """How far behind services may be with frames that bundle adjustment passes over, by name."""
    if "bundle_adjustment" not in fleet:
        return {}
    lag = Window(config.bus.lag_messages, config.bus.lag_mib << 20)
    return {name: lag for name in fleet if processes.BY_NAME[name].may_lag}


def checkpoint_windows(config: Config, fleet: Sequence[str]) -> dict[str, Window]:
    """The windows of those services that may request all since their last usable checkpoint.

    They cover the messages on the way, also to one further down that lags; two intervals for each
    stage down to the disk (one checkpoint may be skipped while another is written); and the
    messages until each stage has reported to the one before it: 60 frames/s for two of its ticks of
    a second.  With less, the others would wait for checkpoints that need more frames.
    """

    def stages(name: str) -> int:
        if processes.BY_NAME[name].observer:
            return 0
        readers = processes.readers_of(name, fleet).values()
        return 1 + max((stages(reader) for those in readers for reader in those), default=0)

    bus = config.bus

    def window(depth: int) -> Window:
        lag = max((lag.messages for lag in lags(config, fleet).values()), default=0)
        on_the_way = 2 * bus.window + lag
        kept = on_the_way + 2 * bus.checkpoint_frames * depth + _TOLD_MESSAGES * (depth + 1)
        return Window(kept, sys.maxsize)

    return {
        name: window(stages(name))
        for name in fleet
        if processes.BY_NAME[name].inputs and not processes.BY_NAME[name].observer
    }


def random_delays(largest_ms: float) -> Callable[[], None] | None:
    """For tests of the bus: every tenth message is delayed by up to this long."""
    if largest_ms <= 0.0:
        return None
    random = np.random.default_rng(os.getpid())

    def wait() -> None:
        if random.random() < 0.1:
            time.sleep(1e-3 * largest_ms * random.random())

    return wait


def end_with_launcher() -> None:
    """Exit when the launcher has ended for any reason: our standard input is its pipe.

    Interrupted first, so that a recording is closed; ended three seconds later.
    """

    def watch() -> None:
        with contextlib.suppress(OSError):
            while os.read(0, 1):
                pass
        main = threading.main_thread().ident
        if main is not None:
            signal.pthread_kill(main, signal.SIGINT)
        time.sleep(_GRACE_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def stop_on_signal() -> Callable[[], bool]:
    """Let SIGINT and SIGTERM end a source after the frame at hand instead of in the middle.

    A second one does not wait for that frame, which a reader may hold up.
    """
    stopped = threading.Event()

    def on_signal(*_: object) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt
        stopped.set()

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, on_signal)
        signal.signal(signal.SIGTERM, on_signal)
    return stopped.is_set
