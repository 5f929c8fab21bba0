"""Packets to pictures, by the FFmpeg libraries that OpenCV's wheel brings along.

``cv2.VideoCapture`` cannot turn an interlaced picture into BGR: swscale refuses, OpenCV passes over
that, and what comes out is what was in memory.  And it scales a picture of another size to the
first one's without saying so.  Its raw mode gives the packets.  They are decoded here by the same
libraries, with the same conversion, to the same pixels, and each picture has its properties.

The calls are public, and so are the members of structures that are read; FFmpeg keeps both within
a major version.  With libraries of other versions, or none, there is no ``PacketDecoder``.
"""

import ctypes as c
import weakref
from functools import cache
from pathlib import Path
from typing import Any, Protocol, cast

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.image.fields import one_field

_VERSIONS = {"avutil": 60, "avcodec": 62, "swscale": 9}
"""Major versions of FFmpeg 8, whose structures are below."""
_DECODERS = {
    "h264": b"h264",
    "hevc": b"hevc",
    "mpg1": b"mpeg1video",
    "mpg2": b"mpeg2video",
    "dvsd": b"dvvideo",
    "apch": b"prores",
    "VP80": b"vp8",
    "VP90": b"vp9",
}
"""By what OpenCV calls a codec: those that need nothing but their packets."""
_BGR24, _BICUBIC, _ALIGNMENT = 3, 4, 32
_INTERLACED = 1 << 3
_WIDE_PRIMARIES, _HDR_CURVES = (9, 11, 12), (16, 18)
"""BT.2020, DCI-P3 and Display P3; PQ and HLG."""
_GIVE_UP = 64
_QUARTERS = {90: cv2.ROTATE_90_CLOCKWISE, 180: cv2.ROTATE_180, 270: cv2.ROTATE_90_COUNTERCLOCKWISE}


class _Packet(c.Structure):
    _fields_ = (
        *(("buf", c.c_void_p), ("pts", c.c_int64), ("dts", c.c_int64)),
        *(("data", c.c_void_p), ("size", c.c_int)),
    )


class _Frame(c.Structure):
    _fields_ = (
        *(("data", c.c_void_p * 8), ("linesize", c.c_int * 8), ("extended_data", c.c_void_p)),
        *(("width", c.c_int), ("height", c.c_int), ("nb_samples", c.c_int), ("format", c.c_int)),
        *(("pict_type", c.c_int), ("sample_aspect_ratio", c.c_int * 2)),
        *(("pts", c.c_int64), ("pkt_dts", c.c_int64), ("time_base", c.c_int * 2)),
        *(("quality", c.c_int), ("opaque", c.c_void_p), ("repeat_pict", c.c_int)),
        *(("sample_rate", c.c_int), ("buf", c.c_void_p * 8), ("extended_buf", c.c_void_p)),
        *(("nb_extended_buf", c.c_int), ("side_data", c.c_void_p), ("nb_side_data", c.c_int)),
        *(("flags", c.c_int), ("color_range", c.c_int), ("color_primaries", c.c_int)),
        *(("color_trc", c.c_int), ("colorspace", c.c_int)),
    )


_CALLS: dict[str, tuple[str, Any, list[Any]]] = {
    "avcodec_find_decoder_by_name": ("avcodec", c.c_void_p, [c.c_char_p]),
    "avcodec_alloc_context3": ("avcodec", c.c_void_p, [c.c_void_p]),
    "avcodec_open2": ("avcodec", c.c_int, [c.c_void_p] * 3),
    "avcodec_send_packet": ("avcodec", c.c_int, [c.c_void_p] * 2),
    "avcodec_receive_frame": ("avcodec", c.c_int, [c.c_void_p] * 2),
    "avcodec_flush_buffers": ("avcodec", None, [c.c_void_p]),
    "avcodec_free_context": ("avcodec", None, [c.c_void_p]),
    "av_packet_alloc": ("avcodec", c.c_void_p, []),
    "av_new_packet": ("avcodec", c.c_int, [c.c_void_p, c.c_int]),
    "av_packet_unref": ("avcodec", None, [c.c_void_p]),
    "av_packet_free": ("avcodec", None, [c.c_void_p]),
    "av_frame_alloc": ("avutil", c.c_void_p, []),
    "av_frame_get_buffer": ("avutil", c.c_int, [c.c_void_p, c.c_int]),
    "av_frame_unref": ("avutil", None, [c.c_void_p]),
    "av_frame_free": ("avutil", None, [c.c_void_p]),
    "av_opt_set_int": ("avutil", c.c_int, [c.c_void_p, c.c_char_p, c.c_int64, c.c_int]),
    "sws_alloc_context": ("swscale", c.c_void_p, []),
    "sws_scale_frame": ("swscale", c.c_int, [c.c_void_p] * 3),
    "sws_freeContext": ("swscale", None, [c.c_void_p]),
}


class Reader(Protocol):
    """Has properties as ``cv2.VideoCapture`` does."""

    def get(self, property_id: int, /) -> float: ...


class PacketDecoder:
    """A ``cv2.VideoCapture`` in raw mode and a decoder: reads as a ``cv2.VideoCapture`` does.

    interlaced: whether the picture at hand consists of two fields; the first is given.
    """

    def __init__(self, packets: cv2.VideoCapture, rotation_deg: int = 0) -> None:
        """packets: at its first one.     rotation_deg: clockwise.     Raises LookupError."""
        calls = _calls()
        if calls is None:
            raise LookupError("FFmpeg's libraries")
        codec = calls["avcodec_find_decoder_by_name"](_DECODERS[codec_of(packets)])
        self._packets, self._calls, self._rotation = packets, calls, _QUARTERS.get(rotation_deg)
        self._context = calls["avcodec_alloc_context3"](codec)
        self._packet = calls["av_packet_alloc"]()
        self._picture, self._bgr = calls["av_frame_alloc"](), calls["av_frame_alloc"]()
        self._scaler = calls["sws_alloc_context"]()
        weakref.finalize(self, _free, calls, self._context, self._packet, self._picture, self._bgr)
        weakref.finalize(self, calls["sws_freeContext"], self._scaler)
        calls["av_opt_set_int"](self._context, b"threads", 1, 0)
        calls["av_opt_set_int"](self._scaler, b"sws_flags", _BICUBIC, 0)
        self._frame = _Frame.from_address(self._picture)
        self._after_ns = 0
        self._head = parameter_sets(packets)
        if not codec or calls["avcodec_open2"](self._context, codec, None) < 0:
            raise LookupError("its decoder")

    @property
    def interlaced(self) -> bool:
        return bool(self._frame.flags & _INTERLACED)

    @property
    def wide_gamut(self) -> bool:
        """Whether its colours are those of HDR video or of a wide gamut.

        ``cv2.VideoCapture`` maps them to those of ordinary screens, which takes ten times as long
        as decoding.  Here they stay as they are coded.
        """
        frame = self._frame
        return frame.color_primaries in _WIDE_PRIMARIES or frame.color_trc in _HDR_CURVES

    def grab(self) -> bool:
        """Decode the next picture; False at the end, and where a packet does not decode."""
        failures = 0
        while failures <= _GIVE_UP:
            while self._calls["avcodec_receive_frame"](self._context, self._picture) >= 0:
                if self._frame.pts >= self._after_ns:
                    return True
            more = self._packets.grab()
            read, data = self._packets.retrieve() if more else (False, None)
            if not more:  # what the decoder still holds
                self._calls["avcodec_send_packet"](self._context, None)
                received = self._calls["avcodec_receive_frame"](self._context, self._picture)
                return received >= 0
            if not read or not self._send(cast(U8, data)):
                return False
            failures += 1
        return False

    def retrieve(self) -> tuple[bool, U8 | None]:
        """(H, W, 3) BGR of the picture at hand, or of its first field, turned as the container
        says."""
        calls, bgr = self._calls, _Frame.from_address(self._bgr)
        calls["av_frame_unref"](self._bgr)
        bgr.format, bgr.width, bgr.height = _BGR24, self._frame.width, self._frame.height
        if calls["av_frame_get_buffer"](self._bgr, _ALIGNMENT) < 0:
            return False, None
        bgr.flags = self._frame.flags & _INTERLACED
        bgr.color_primaries, bgr.color_trc = self._frame.color_primaries, self._frame.color_trc
        if calls["sws_scale_frame"](self._scaler, self._bgr, self._picture) < 0:
            return False, None
        rows = c.cast(bgr.data[0], c.POINTER(c.c_uint8))
        lines = np.ctypeslib.as_array(rows, (bgr.height, bgr.linesize[0]))
        pixels = lines[:, : 3 * bgr.width].reshape(bgr.height, bgr.width, 3)
        pixels = one_field(pixels) if self.interlaced else pixels.copy()
        if self._rotation is not None:
            pixels = cast(U8, cv2.rotate(pixels, self._rotation))
        return True, pixels

    def read(self) -> tuple[bool, U8 | None]:
        """The next picture."""
        return self.retrieve() if self.grab() else (False, None)

    def get(self, property_id: int) -> float:
        """As of ``cv2.VideoCapture``."""
        if property_id == cv2.CAP_PROP_POS_MSEC:
            return 1e-6 * self._frame.pts
        return self._packets.get(property_id)

    def set(self, property_id: int, value: float) -> bool:
        """Go to a frame, as nearly as the frame rate allows; nothing else can be set."""
        rate = self._packets.get(cv2.CAP_PROP_FPS)
        if property_id != cv2.CAP_PROP_POS_FRAMES or rate <= 0.0:
            return False
        self._calls["avcodec_flush_buffers"](self._context)
        self._after_ns = round(1e9 * (value - 0.5) / rate)
        return self._packets.set(property_id, value)

    def release(self) -> None:
        """Let go of the file."""
        self._packets.release()

    def _send(self, data: U8) -> bool:
        """Hand a packet to the decoder; its time is in ns."""
        calls, data = self._calls, np.concatenate((self._head, data.reshape(-1)))
        self._head = self._head[:0]
        if calls["av_new_packet"](self._packet, data.size) < 0:
            return False
        packet = _Packet.from_address(self._packet)
        c.memmove(packet.data, data.ctypes.data, data.size)
        packet.pts = round(1e6 * self._packets.get(cv2.CAP_PROP_POS_MSEC))
        sent = calls["avcodec_send_packet"](self._context, self._packet)
        calls["av_packet_unref"](self._packet)
        return sent >= 0


def codec_of(capture: Reader) -> str:
    """OpenCV's name of the codec of a stream."""
    return (
        int(capture.get(cv2.CAP_PROP_FOURCC))
        .to_bytes(8, "little", signed=True)[:4]
        .decode("latin-1")
    )


def parameter_sets(packets: cv2.VideoCapture) -> U8:
    """The parameter sets that a decoder of H.264 needs before a first packet that is no IDR
    picture, as in a clip cut from another: OpenCV puts them before IDR pictures alone."""
    index = int(packets.get(cv2.CAP_PROP_CODEC_EXTRADATA_INDEX))
    head = cast(U8 | None, packets.retrieve(None, index)[1])
    data = head.tobytes() if head is not None else b""
    if codec_of(packets) != "h264" or data[:1] != b"\1":  # no avcC of ISO/IEC 14496-15
        return np.zeros(0, np.uint8)
    units, at = b"", 5
    for mask in (0x1F, 0xFF):  # sequence parameter sets, picture parameter sets
        count, at = data[at] & mask if at < len(data) else 0, at + 1
        for _ in range(count):
            end = at + 2 + int.from_bytes(data[at : at + 2])
            units, at = units + b"\0\0\0\1" + data[at + 2 : end], end
    return np.frombuffer(units, np.uint8)


def decodes(codec: str) -> bool:
    """Whether there is a ``PacketDecoder`` for a codec."""
    return codec in _DECODERS and _calls() is not None


@cache
def _calls() -> dict[str, Any] | None:
    """The functions, or None where OpenCV has other libraries."""
    try:
        libraries = {name: _library(name) for name in _VERSIONS}
        for name, major in _VERSIONS.items():
            if getattr(libraries[name], f"{name}_version")() >> 16 != major:
                return None
        calls: dict[str, Any] = {}
        for name, (where, result, arguments) in _CALLS.items():
            calls[name] = getattr(libraries[where], name)
            calls[name].restype, calls[name].argtypes = result, arguments
    except (OSError, AttributeError, StopIteration):
        return None
    return calls


def _library(name: str) -> c.CDLL:
    """A library of OpenCV's wheel, which is in memory already.  Raises OSError, StopIteration."""
    packages = Path(cv2.__file__).parent.parent
    return c.CDLL(str(next(packages.glob(f"opencv_python*.libs/lib{name}-*.so*"))))


def _free(calls: dict[str, Any], context: int, packet: int, *frames: int) -> None:
    calls["avcodec_free_context"](c.byref(c.c_void_p(context)))
    calls["av_packet_free"](c.byref(c.c_void_p(packet)))
    for frame in frames:
        calls["av_frame_free"](c.byref(c.c_void_p(frame)))
