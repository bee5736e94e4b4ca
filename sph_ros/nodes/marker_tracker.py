# SPDX-License-Identifier: Apache-2.0
"""``marker_tracker``: pictures of printed markers in, poses of solids out.

A thread of its own fetches the newest picture from a topic or from the mailbox of a source, so that
no picture ever waits behind another. While nobody listens no picture is subscribed to and no camera
is open.
"""

import sys
import threading
import time
import traceback
from functools import partial
from pathlib import Path

import cv2
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from msg_adapters.image import COMPRESSED_IMAGE
from sph_ros.nodes.help_texts import help_text
from sph_ros.nodes.image_source import Encoded, Picture, SourceError, decoded, make_source
from sph_ros.nodes.marker_camera import CalibrationChoice, WaitingError
from sph_ros.nodes.marker_diagnostics import Problems, input_status, target_status
from sph_ros.nodes.marker_input import TopicInput
from sph_ros.nodes.marker_mailbox import Mailbox
from sph_ros.nodes.marker_parameters import MEASURED, MarkerParameters, TrackerParameterError
from sph_ros.nodes.marker_publications import MarkerPublications
from sph_ros.nodes.picture_topics import find_topics
from sph_ros.nodes.running import run_node
from sph_ros.tracking.camera import CameraError
from sph_ros.tracking.camera_message import CAMERA_INFO
from sph_ros.tracking.detection import DictionaryError
from sph_ros.tracking.drawing import draw_notes, draw_tracking
from sph_ros.tracking.images import ImageError, to_bgr, to_gray
from sph_ros.tracking.preparation import prepare
from sph_ros.tracking.targets import TargetError
from sph_ros.tracking.tracker import Tracker
from sph_ros.waiting import tell_while_waiting

#: Without a picture for so long [s] something is wrong with where they come from.
SILENCE = 2.0

#: How often it is looked whether anybody listens, and what there is to listen to [s].
ATTENTION_PERIOD = 0.2

#: A picture older than this [s] is a recording; its age says nothing about latency.
LONGEST_LATENCY = 0.3

#: The tracker's thread looks so often whether it shall end [s].
WAIT = 0.2


class MarkerTracker(Node):
    """The tracker node, named `marker_tracker`.

    Args:
        kwargs: for `rclpy.node.Node`.

    Raises:
        TrackerParameterError, TargetError, DictionaryError, SourceError: a parameter is wrong.
    """

    def __init__(self, **kwargs):
        super().__init__("marker_tracker", **kwargs)
        self._running = False
        self._source = None
        try:
            self._set_up()
        except BaseException:
            super().destroy_node()
            raise

    def _set_up(self):
        cv2.setNumThreads(1)  # the cores belong to the simulation
        self._settings = parameters = MarkerParameters(self)
        self._problems = Problems()
        self._tracker, self._tracker_error, self._rebuild = None, None, True
        self._tracking = None
        self._counts = {"processed": 0, "refused": 0}
        self._milliseconds, self._size, self._last_picture = 0.0, "", None
        names = parameters.solid_names()
        self._publications = MarkerPublications(
            self,
            names,
            parameters["world_frame"],
            parameters["publish_tf"],
            with_pictures=bool(parameters.source),
        )
        self._input_topics = find_topics(self)
        from_topics = not parameters.source
        source = None if from_topics else self._make_source()  # a wrong one is noticed at once
        self._calibration = CalibrationChoice(
            parameters["camera_info_url"], self._rectified(), from_topics or source.brings_camera
        )
        if from_topics:
            self._inbox = TopicInput(self, self._calibration.hear)
            # Before anything takes long: who sees us hear pictures may send camera_info only once.
            self._inbox.listen(awake=False)
        else:
            self._inbox = Mailbox()
        self._make_tracker()
        self._prepared, self._awake_since = False, None
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(ATTENTION_PERIOD, self._attend, clock=steady)
        self.create_timer(1.0, self._diagnose, clock=steady)
        parameters.follow(self._settings_changed)
        self._running = True
        self._thread = threading.Thread(target=self._work, name="tracker", daemon=True)
        self._thread.start()
        where = parameters.source or self._input_topics["image"]
        self.get_logger().info(f"tracking {', '.join(names) or 'nothing'} in {where}")

    def destroy_node(self):
        """End the threads first: they publish."""
        if self._running:
            self._running = False
            self._thread.join(timeout=10.0)
        self._stop_source()
        super().destroy_node()

    def _rectified(self):
        kind = self._settings["image_kind"]
        return kind == "rectified" or (kind == "auto" and "rect" in self._input_topics["image"])

    # ---------------------------------------------------------------- listening, only when needed

    def _attend(self):
        """Open what is needed and close what is not."""
        wanted = not self._settings["lazy"] or self._publications.listeners() > 0
        awake = wanted and self._prepared  # a short recording must not be over before that
        if awake and self._awake_since is None:
            self._awake_since = time.monotonic()
        elif not awake:
            self._awake_since = None
        if self._settings.source:
            self._attend_source(awake)
        else:
            self._inbox.listen(awake)

    def _attend_source(self, awake):
        if awake and self._source is None:
            self._source = self._make_source()
            self._source.start()
        elif not awake:
            self._stop_source()

    def _make_source(self):
        get = self._settings
        return make_source(
            get.source, self._put, get["source_rate"], get["source_topic"], get["loop"]
        )

    def _stop_source(self):
        if self._source is not None:
            self._source.stop()
            self._source = None

    def _put(self, thing):
        """A source has a picture, or a bag's camera_info."""
        if isinstance(thing, Encoded) and thing.type == CAMERA_INFO:
            self._calibration.hear(thing.data)
        else:
            if isinstance(thing, Picture) and not thing.stamp_ns:
                thing = thing._replace(stamp_ns=self.get_clock().now().nanoseconds)
            self._inbox.put(thing)

    # ---------------------------------------------------------------- a picture

    def _work(self):
        """The tracker's thread."""
        self._prepare()
        while self._running:
            begin = None
            try:
                thing = self._inbox.get(WAIT)
                if thing is None:
                    continue
                begin = self._last_picture = time.monotonic()
                self._process(thing)
                self._counts["processed"] += 1
            except WaitingError:
                continue
            except Exception as error:
                if not (self._running and self.context.ok()):
                    return
                self._counts["refused"] += 1
                self._complain(_kind(error), _one_line(error))
                if begin is None:  # no picture, so nothing slows this loop down
                    time.sleep(WAIT)
                    continue
            spent = 1e3 * (time.monotonic() - begin)
            self._milliseconds += 0.1 * (spent - self._milliseconds)

    def _prepare(self):
        """Load the kernels before they are needed; say so where it takes long."""
        log = self.get_logger()
        try:
            with tell_while_waiting(lambda s: log.info(f"preparing, first run: {s:.0f} s")):
                prepare()
        except Exception as error:  # then pictures will say what is wrong
            self._complain("fault", f"preparing: {_one_line(error)}")
        self._prepared = True

    def _process(self, thing):
        debug = self._publications.debug_due(self._settings["debug_rate"])
        shared = self._publications.pictures_wanted()
        pixels, encoding, stamp_ns, frame = decoded(thing, color=debug or shared)
        stamp_ns = stamp_ns or self.get_clock().now().nanoseconds
        gray = to_gray(pixels, encoding)
        height, width = gray.shape
        self._size = f"{width} x {height} {_format(thing, encoding)}"
        picture = to_bgr(pixels, encoding).copy() if debug else None
        try:
            if shared:  # with those who draw on the pictures of our own source
                camera = self._calibration.for_picture(width, height)
                self._publications.publish_picture(pixels, encoding, camera, stamp_ns, frame)
            self._track(gray, stamp_ns, frame, picture)
        except (CameraError, TargetError, DictionaryError) as error:
            if picture is not None:
                self._publications.publish_debug(draw_notes(picture, [str(error)]), stamp_ns, frame)
            raise

    def _track(self, gray, stamp_ns, frame, picture):
        camera = self._calibration.for_picture(gray.shape[1], gray.shape[0])
        note = self._calibration.note(camera)
        if note:
            self._complain("approximate", note)
        tracker = self._current_tracker()
        tracking = tracker.process(gray, stamp_ns, camera, self._lookahead(stamp_ns))
        if tracking is None:  # a straggler
            return
        self._tracking = tracking
        world = tracker.settings.world
        self._publications.publish(tracking, stamp_ns, frame, world is not None)
        for problem in tracking.problems:
            self._complain(*problem)
        if picture is not None:
            targets = {t.name: t for t in (*tracker.settings.solids, *((world,) if world else ()))}
            notes = [note] if note else []
            draw_tracking(picture, tracking, targets, camera, notes)
            self._publications.publish_debug(picture, stamp_ns, frame)

    def _lookahead(self, stamp_ns):
        """How far poses are predicted beyond the stamp [s]."""
        prediction = self._settings["prediction"]
        if prediction != MEASURED:
            return max(0.0, prediction)
        age = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
        return age if 0.0 <= age <= LONGEST_LATENCY else 0.0

    def _complain(self, kind, text):
        if self._problems.note(kind, text):
            self.get_logger().warning(text)

    # ---------------------------------------------------------------- parameters

    def _settings_changed(self):
        self._rebuild = True

    def _make_tracker(self):
        """A tracker after the present parameters; a wrong marker size may still be mended."""
        self._rebuild = False
        try:
            self._tracker, self._tracker_error = Tracker(self._settings.settings()), None
        except TargetError as error:
            self._tracker, self._tracker_error = None, error
            self.get_logger().error(str(error))

    def _current_tracker(self):
        if self._rebuild:
            self._make_tracker()
        if self._tracker_error is not None:
            raise self._tracker_error
        return self._tracker

    # ---------------------------------------------------------------- diagnostics

    def _diagnose(self):
        if self._diagnostics.get_subscription_count() == 0:
            return
        name, idle = self.get_name(), self._awake_since is None
        state = "pictures come" if self._prepared else "preparing"
        problems = {} if idle else {**self._problems.recent(), **self._silence()}
        if self._rebuild and idle:
            self._make_tracker()
        if self._tracker_error is not None:
            problems["marker size"] = str(self._tracker_error)
        statuses = [input_status(name, state, self._facts(), problems, idle and self._prepared)]
        tracking, tracker = self._tracking, self._tracker
        if tracker is not None:
            if tracker.settings.world is not None:
                world = None if tracking is None else tracking.world
                statuses.append(target_status(name, "world", world, True))
            for solid in tracker.settings.solids:
                tracked = None if tracking is None else tracking.solids.get(solid.name)
                statuses.append(target_status(name, solid.name, tracked, False))
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def _silence(self):
        """What is wrong when no picture comes."""
        source = self._source
        if source is not None and source.problem:
            return {"source": source.problem}
        since = max(self._last_picture or 0.0, self._awake_since or 0.0)
        silent = time.monotonic() - since
        if silent < SILENCE:
            return {}
        where = source.name if source is not None else self._input_topics["image"]
        return {"silence": f"no picture from {where} for {silent:.0f} s"}

    def _facts(self):
        return {
            "source": self._settings.source or self._input_topics["image"],
            "pictures_processed": self._counts["processed"],
            "pictures_refused": self._counts["refused"],
            "pictures_dropped": self._inbox.dropped,
            "picture_time_ms": self._milliseconds,
            "picture": self._size,
            **{
                f"problems_{kind.replace(' ', '_')}": n for kind, n in self._problems.counts.items()
            },
        }


def _format(thing, encoding):
    """What pictures come as, for people."""
    compressed = isinstance(thing, Encoded) and thing.type == COMPRESSED_IMAGE
    return "compressed" if compressed else encoding


def _one_line(error):
    """For people; with the place in the code where the mistake is ours."""
    text = " ".join(str(error).split())
    if _kind(error) != "fault":
        return text or repr(error)
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {text}"


def _kind(error):
    for kind, types in (("calibration", CameraError), ("marker size", TargetError)):
        if isinstance(error, types):
            return kind
    return "image" if isinstance(error, ImageError | ValueError | cv2.error) else "fault"


def main(argv=None):
    """Run the node until SIGINT or SIGTERM; returns the exit status."""
    explain = partial(
        help_text,
        "marker_tracker",
        "Finds printed ArUco markers in pictures; publishes where camera and solids are.",
        MarkerParameters,
    )
    errors = (TrackerParameterError, TargetError, DictionaryError, SourceError)
    return run_node("marker_tracker", MarkerTracker, argv, errors, explain)


if __name__ == "__main__":
    sys.exit(main())
