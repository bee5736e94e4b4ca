# SPDX-License-Identifier: Apache-2.0
"""The server of the page: viser at exactly the address that was asked for. No rclpy."""

import errno
import socket

import viser

#: So much [bytes] may be on its way to a browser; the system would let some megabytes queue up.
SEND_BUFFER = 1 << 17

#: Ports looked at for one to propose instead of a taken one.
PROPOSED_PORTS = 100


class ViewerError(ValueError):
    """The viewer cannot start; one line that says why."""


def start_server(host, port):
    """A ViserServer at an address.

    Raises:
        ViewerError: the port is taken, or the host is not an address of this machine.
    """
    # Asked first, because viser would silently take another port.
    error = _bind_error(host, port)
    if error is None:
        server = viser.ViserServer(host, port, label="sph_ros", verbose=False)
        if server.get_port() == port:
            server.on_client_connect(lambda client: _keep_queue_short(server, client.client_id))
            return server
        server.stop()  # somebody took it in between
    elif error.errno != errno.EADDRINUSE:
        raise ViewerError(f"cannot listen on {host}:{port}: {error.strerror or error}")
    text = f"port {port} is taken by another program; choose another with --port"
    raise ViewerError(text + _proposal(host, port))


def _keep_queue_short(server, client_id):
    """Let little wait in the socket, so that a slow browser gets new pictures instead of many.

    viser sends only the newest of what a socket has no room for. It has no public way to the
    socket; without this a slow connection shows the past.
    """
    connections = getattr(getattr(server, "_websock_server", None), "_live_connections", {})
    transport = getattr(connections.get(client_id), "transport", None)
    if transport is not None:
        transport.get_extra_info("socket").setsockopt(
            socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER
        )


def _bind_error(host, port):
    """The OSError of listening there, or None."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            return error
    return None


def _proposal(host, port):
    for other in range(port + 1, min(port + 1 + PROPOSED_PORTS, 65536)):
        if _bind_error(host, other) is None:
            return f", such as --port {other}"
    return ""
