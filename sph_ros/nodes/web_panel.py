# SPDX-License-Identifier: Apache-2.0
"""The panel beside the picture: how the liquid is, and what somebody wants of it. No rclpy."""

import time
from collections import deque
from html import escape

import viser

from sph_ros.nodes.web_colors import COLORINGS, TABLES
from sph_ros.nodes.web_controls import NumberControl

#: A notice stays for so long [s].
NOTICE_TIME = 10.0

#: Colours of the state's dot: by level of the diagnostics, and for a node that is away.
GOOD, WARNING, BAD, AWAY = "#2f9e44", "#e8940a", "#e03131", "#868e96"

PAUSE, RESUME, STEP, RESET = "pause", "resume", "step", "reset"
RECORD = "record"

_NOTICE = (
    '<div role="alert" style="margin:0 .7em .7em;padding:.5em .8em;border-radius:.3em;'
    'border-left:.3em solid {color};background:{color}1f;font-size:.87em">{text}</div>'
)
_STATE = (
    '<div style="padding:0 .8em .8em;font-size:.87em">'
    '<div style="font-weight:600;padding-bottom:.3em"><span style="color:{color}">&#9679;</span> '
    '{title}</div><table style="width:100%;border-spacing:0">{rows}</table></div>'
)
_ROW = (
    '<tr><td style="opacity:.65;width:7.4em">{name}</td>'
    '<td style="font-variant-numeric:tabular-nums">{value}</td></tr>'
)
_LEGEND = (
    '<div style="display:flex;gap:.6em;align-items:center;padding:0 .8em .8em;font-size:.8em">'
    '<span>{low:.3g}</span><div style="flex:1;height:.7em;border-radius:.2em;'
    'background:linear-gradient(to right,{stops})"></div><span>{high:.3g} {unit}</span></div>'
)


class Panel:
    """The panel.

    What people do is kept in `actions` until somebody takes it; numbers are asked for with `edits`.

    Args:
        server: a ViserServer.
        options: ViewOptions that the panel changes by itself.
        scenes: names to choose from.

    Attributes:
        actions: deque of (name, argument): PAUSE, RESUME, STEP, RESET, RECORD or "view" with None,
            "scene" with a name or path.
    """

    def __init__(self, server, options, scenes):
        self._gui, self._options = server.gui, options
        self.actions = deque()
        self._controls, self._notice_end, self._legend_text = {}, None, None
        self._scene_names = list(scenes)
        server.gui.configure_theme(
            show_logo=False, show_share_button=False, brand_color=(34, 118, 178)
        )
        self._notice = server.gui.add_html("", visible=False)
        self._state = server.gui.add_html("")
        self.show_state(AWAY, "waiting for the fluid node ...", ())
        self._add_buttons()
        tabs = server.gui.add_tab_group()
        with tabs.add_tab("View"):
            self._add_view()
        self._liquid = tabs.add_tab("Liquid")
        with self._liquid:
            self._no_liquid = server.gui.add_markdown("The fluid node tells its parameters here.")
        with tabs.add_tab("Scene"):
            self._add_scenes()

    # ---------------------------------------------------------------- what is shown

    def show_state(self, color, title, rows):
        """Show how the liquid is: a dot's colour, a line and (name, value) rows of text."""
        text = "".join(_ROW.format(name=escape(n), value=escape(v)) for n, v in rows)
        _assign(self._state, content=_STATE.format(color=color, title=escape(title), rows=text))

    def show_paused(self, paused):
        """Offer to go on instead of to pause."""
        options = (RESUME if paused else PAUSE, STEP, RESET)
        if tuple(self._run.options) != options:
            self._run.options = options

    def say(self, text, color=WARNING):
        """Show a notice on top of the panel for some seconds."""
        self._notice.content = _NOTICE.format(color=color, text=escape(text))
        _assign(self._notice, visible=True)
        self._notice_end = time.monotonic() + NOTICE_TIME

    def show_recording(self, text):
        """What the running recording has so far; None where there is none."""
        label = "record" if text is None else f"stop recording: {text}"
        _assign(self._record, label=label, color="gray" if text is None else "red")

    def show_legend(self, legend):
        """The scale of the particles' colours: (lowest, highest, unit), or None."""
        if not self._options.particles or legend is None:
            _assign(self._legend, visible=False)
            return
        low, high, unit = legend
        table = TABLES[self._options.coloring]
        stops = ",".join(f"rgb{tuple(map(int, rgb))}" for rgb in table[::32])
        text = _LEGEND.format(low=low, high=high, unit=escape(unit), stops=stops)
        _assign(self._legend, content=text, visible=True)

    def show_parameters(self, infos):
        """Numbers to change: label -> NumberInfo."""
        _assign(self._no_liquid, visible=not infos)
        for label in [label for label in self._controls if label not in infos]:
            self._controls.pop(label).remove()
        for label, info in infos.items():
            if label in self._controls:
                self._controls[label].show(info)
            else:
                with self._liquid:
                    self._controls[label] = NumberControl(self._gui, label, info)

    def restore(self, label):
        """Show a number as it is, not as somebody wanted it."""
        if label in self._controls:
            self._controls[label].restore()

    def show_scene(self, name):
        """The scene that runs: a packaged name or a path."""
        packaged = name in self._scene_names
        options = self._scene_names if packaged else [name, *self._scene_names]
        if list(self._scene.options) != options:
            self._scene.options = options
        _assign(self._scene, value=name)

    # ---------------------------------------------------------------- what people want

    def edits(self):
        """(label, value) of the numbers that somebody changed since the last call."""
        for label, control in list(self._controls.items()):
            try:
                value = control.take()
            except ValueError as error:
                self.say(str(error), BAD)
                control.restore()
                continue
            if value is not None:
                yield label, value

    def tick(self):
        """To be called often: takes the notice away when it is old."""
        if self._notice_end is not None and time.monotonic() > self._notice_end:
            self._notice_end = None
            _assign(self._notice, visible=False)

    # ---------------------------------------------------------------- parts

    def _act(self, name, argument=None):
        self.actions.append((name, argument))

    def _add_buttons(self):
        self._run = self._gui.add_button_group("simulation", (PAUSE, STEP, RESET))

        # Coroutines run in the server's event loop: before the next click changes the value.
        @self._run.on_click
        async def _(event):
            self._act(event.target.value)

        self._record = self._gui.add_button(
            "record",
            icon=viser.Icon.PLAYER_RECORD,
            color="gray",
            hint="Write all that the fluid node says to a bag",
        )
        self._record.on_click(lambda _: self._act(RECORD))

    def _add_view(self):
        options = self._options
        for label, name in (("water", "surface"), ("particles", "particles")):
            self._add_checkbox(label, name)
        coloring = self._gui.add_dropdown("coloured by", COLORINGS, initial_value=options.coloring)
        coloring.on_update(lambda _: setattr(options, "coloring", coloring.value))
        self._legend = self._gui.add_html("", visible=False)
        size = self._gui.add_slider(
            "particle size", 0.2, 2.0, 0.05, options.particle_size, marks=()
        )
        size.on_update(lambda _: setattr(options, "particle_size", size.value))
        for label in ("frames", "grid"):
            self._add_checkbox(label, label)
        whole = self._gui.add_button("look at all", icon=viser.Icon.FOCUS_CENTERED, color="gray")
        whole.on_click(lambda _: self._act("view"))

    def _add_checkbox(self, label, option):
        box = self._gui.add_checkbox(label, getattr(self._options, option))
        box.on_update(lambda _: setattr(self._options, option, box.value))

    def _add_scenes(self):
        self._scene = self._gui.add_dropdown("scene", self._scene_names or ["-"])
        self._file = self._gui.add_text("file", "", hint="Path of a YAML file, for the fluid node")
        button = self._gui.add_button("load the file", color="gray")

        @self._scene.on_update
        def _(event):
            if event.client is not None:
                self._act("scene", self._scene.value)

        @button.on_click
        def _(_event):
            if self._file.value.strip():
                self._act("scene", self._file.value.strip())
            else:
                self.say("file: expected the path of a scene, got nothing")


def _assign(handle, **fields):
    """Set what differs: every assignment is sent to all browsers."""
    for name, value in fields.items():
        if getattr(handle, name) != value:
            setattr(handle, name, value)
