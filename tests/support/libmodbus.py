"""The C library libmodbus (Debian package libmodbus5) by ctypes: a client, and a server in a thread."""

import ctypes
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from ctypes import POINTER, byref, c_char, c_char_p, c_int, c_uint8, c_uint16, c_uint32, c_void_p

NAME = "libmodbus.so.5"
EXCEPTIONS = 112345678  # errno of exception 0


class Mapping(ctypes.Structure):
    """modbus_mapping_t of libmodbus 3.1."""

    _fields_ = (
        *(
            (f"{word}_{table}", c_int)
            for table in ("bits", "input_bits", "input_registers", "registers")
            for word in ("nb", "start")
        ),
        ("tab_bits", POINTER(c_uint8)),
        ("tab_input_bits", POINTER(c_uint8)),
        ("tab_input_registers", POINTER(c_uint16)),
        ("tab_registers", POINTER(c_uint16)),
    )


def installed() -> bool:
    """Whether the library is there."""
    try:
        ctypes.CDLL(NAME)
    except OSError:
        return False
    return True


def library() -> ctypes.CDLL:
    """Load the library; OSError where it is not installed."""
    found = ctypes.CDLL(NAME, use_errno=True)
    found.modbus_new_tcp.restype = found.modbus_new_rtu.restype = c_void_p
    found.modbus_new_tcp.argtypes = (c_char_p, c_int)
    found.modbus_new_rtu.argtypes = (c_char_p, c_int, c_char, c_int, c_int)
    found.modbus_strerror.restype = c_char_p
    found.modbus_mapping_new_start_address.restype = POINTER(Mapping)
    found.modbus_mapping_free.argtypes = (POINTER(Mapping),)
    for name in ("connect", "close", "free"):
        getattr(found, f"modbus_{name}").argtypes = (c_void_p,)
    found.modbus_set_slave.argtypes = (c_void_p, c_int)
    found.modbus_set_response_timeout.argtypes = (c_void_p, c_uint32, c_uint32)
    for name in ("modbus_read_registers", "modbus_read_input_registers"):
        getattr(found, name).argtypes = (c_void_p, c_int, c_int, POINTER(c_uint16))
    found.modbus_write_register.argtypes = (c_void_p, c_int, c_uint16)
    found.modbus_send_raw_request.argtypes = (c_void_p, c_char_p, c_int)
    found.modbus_receive_confirmation.argtypes = (c_void_p, c_char_p)
    found.modbus_tcp_listen.argtypes = (c_void_p, c_int)
    found.modbus_tcp_accept.argtypes = (c_void_p, POINTER(c_int))
    found.modbus_receive.argtypes = (c_void_p, c_char_p)
    found.modbus_reply.argtypes = (c_void_p, c_char_p, c_int, POINTER(Mapping))
    return found


class Client:
    """A client: reads registers, or returns the exception code as a negative number."""

    def __init__(self, *, port: int = 0, path: str = "", unit: int = 1) -> None:
        self._lib = library()
        self._context = (
            self._lib.modbus_new_rtu(path.encode(), 9600, b"N", 8, 1)
            if path
            else self._lib.modbus_new_tcp(b"127.0.0.1", port)
        )
        self._lib.modbus_set_slave(self._context, unit)
        self._lib.modbus_set_response_timeout(self._context, 10, 0)
        if self._lib.modbus_connect(self._context):
            raise OSError(self._error())

    def close(self) -> None:
        self._lib.modbus_close(self._context)
        self._lib.modbus_free(self._context)

    def read(self, first: int, count: int, *, function: int = 3) -> list[int] | int:
        values = (c_uint16 * count)()
        call = self._lib.modbus_read_registers if function == 3 else self._lib.modbus_read_input_registers
        return list(values) if call(self._context, first, count, values) == count else self._exception()

    def write(self, register: int, value: int) -> int:
        return 0 if self._lib.modbus_write_register(self._context, register, value) == 1 else self._exception()

    def raw(self, request: bytes) -> bytes:
        """Send unit and PDU as they are; return the whole answer."""
        self._lib.modbus_send_raw_request(self._context, request, len(request))
        answer = ctypes.create_string_buffer(260)
        size = self._lib.modbus_receive_confirmation(self._context, answer)
        if size < 0:
            raise OSError(self._error())
        return answer.raw[:size]

    def _exception(self) -> int:
        number = ctypes.get_errno()
        if not EXCEPTIONS < number < EXCEPTIONS + 12:
            raise OSError(self._error())
        return EXCEPTIONS - number

    def _error(self) -> str:
        text: bytes = self._lib.modbus_strerror(ctypes.get_errno())
        return text.decode()


@contextmanager
def served(registers: Sequence[int], *, first: int, unit: int) -> Iterator[int]:
    """Run a server of one connection with these holding and input registers; give its port."""
    lib = library()
    context = lib.modbus_new_tcp(b"127.0.0.1", 0)
    lib.modbus_set_slave(context, unit)
    mapping = lib.modbus_mapping_new_start_address(0, 0, 0, 0, first, len(registers), first, len(registers))
    for i, value in enumerate(registers):
        mapping.contents.tab_registers[i] = mapping.contents.tab_input_registers[i] = value
    listener = socket.socket(fileno=lib.modbus_tcp_listen(context, 1))
    port = listener.getsockname()[1]
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set():
            if lib.modbus_tcp_accept(context, byref(c_int(listener.fileno()))) < 0:
                continue
            query = ctypes.create_string_buffer(260)
            while (size := lib.modbus_receive(context, query)) >= 0:
                if size:
                    lib.modbus_reply(context, query, size, mapping)
            lib.modbus_close(context)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield port
    finally:
        ended.set()
        socket.create_connection(("127.0.0.1", port)).close()
        thread.join()
        listener.close()
        lib.modbus_mapping_free(mapping)
        lib.modbus_free(context)
