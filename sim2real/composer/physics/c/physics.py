"""A compiled model and its state on MuJoCo's C engine."""

from __future__ import annotations

import contextlib
import copy
import logging
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2real.composer.errors import EpisodeInitializationError, PhysicsError
from sim2real.composer.mjcf.element import as_elements
from sim2real.composer.mjcf.schema import mj
from sim2real.composer.physics import layout
from sim2real.composer.physics.base import BaseBinding, BaseModelView, BasePhysics, EmptyBinding, NativeView
from sim2real.composer.physics.named import Named
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from typing import Literal

    from sim2real.composer.mjcf import RootElement as Model
    from sim2real.composer.mjcf.element import Element, Elements
    from sim2real.composer.types import ArrayLike, Index, MjData, MjModel, MjvOption, MjvScene
    from sim2real.types import PyTree

_log = logging.getLogger(__name__)
_RK4 = int(mj.mjtIntegrator.mjINT_RK4)


class ModelView(BaseModelView):
    """``physics.model``: the ``MjModel``."""

    __slots__ = ()

    @contextlib.contextmanager
    def disable(self, *flags: str) -> Iterator[None]:
        """Switch parts of the physics off, such as ``'actuation'`` or ``'contact'``, inside a ``with`` block."""
        before = self.ptr.opt.disableflags
        try:
            for flag in flags:
                self.ptr.opt.disableflags |= int(getattr(mj.mjtDisableBit, f"mjDSBL_{flag.upper()}"))
            yield
        finally:
            self.ptr.opt.disableflags = before


class Images:
    """Draws a model by ``mujoco.Renderer``: one for each thread and size, as OpenGL's contexts belong to threads.

    Later changes of textures and height fields are not drawn.
    """

    def __init__(self, model: MjModel) -> None:
        self._model = model
        self._renderers: dict[tuple[int, int, int], Any] = {}

    def draw(
        self,
        data: MjData,
        height: int,
        width: int,
        camera_id: int | str = -1,
        depth: bool = False,
        segmentation: bool = False,
        scene_option: MjvOption | None = None,
        flags: Mapping[str | int, bool] | None = None,
        scene_callback: Callable[[MjvScene], None] | None = None,
    ) -> np.ndarray:
        """Return an image; see ``Physics.render``."""
        if depth and segmentation:
            raise UsageError("`segmentation` and `depth` cannot both be `True`.")
        if isinstance(camera_id, int) and not -1 <= camera_id < self._model.ncam:
            raise UsageError(f"model has {self._model.ncam} fixed cameras. camera_id={camera_id} is invalid.")
        for name, size in (("width", width), ("height", height)):
            most = getattr(self._model.vis.global_, f"off{name}")
            if size > most:
                raise UsageError(
                    f"Image {name} {size} > framebuffer {name} {most}",
                    hint=f'a smaller image, or `<visual><global off{name}="{size}"/></visual>` in the model',
                )
        wanted = {_flag(name): value for name, value in (flags or {}).items()}
        place = threading.get_ident(), height, width
        if place not in self._renderers:
            self._renderers[place] = mj.Renderer(self._model, height, width)
        renderer = self._renderers[place]
        renderer.disable_depth_rendering()
        renderer.disable_segmentation_rendering()
        if depth:
            renderer.enable_depth_rendering()
        if segmentation:
            renderer.enable_segmentation_rendering()
        option = getattr(scene_option, "ptr", scene_option)
        renderer.update_scene(data, camera_id, option)
        before = renderer.scene.flags.copy()
        try:
            for flag, value in wanted.items():
                renderer.scene.flags[flag] = value
            if scene_callback is not None:
                scene_callback(renderer.scene)
            return renderer.render()
        finally:
            renderer.scene.flags[:] = before

    def close(self) -> None:
        """Free the renderers of this thread, and drop references to those of other threads."""
        for (thread, *_), renderer in self._renderers.items():
            if thread == threading.get_ident():
                renderer.close()
        self._renderers.clear()


def _flag(name: str | int) -> int:
    names = {k.removeprefix("mjRND_").lower(): int(v) for k, v in mj.mjtRndFlag.__members__.items()}
    if isinstance(name, str) and name not in names:
        raise UsageError(f"there is no render flag {name!r}. Available: {', '.join(names)}")
    return names[name] if isinstance(name, str) else int(name)


class Staleness:
    """Whether a physics was changed after its derived quantities were last computed.

    A separate object, because every read of a bound attribute looks it up.
    """

    __slots__ = ("dirty",)

    def __init__(self) -> None:
        self.dirty = False


class Physics(BasePhysics):
    """A compiled model and its state on MuJoCo's C engine; see ``BasePhysics``.

    Args:
        legacy_step: After a step, also compute positions and velocities of the new state, as dm_control does.
    """

    np = np

    def __init__(self, model: MjModel, legacy_step: bool = True) -> None:
        self.legacy_step = legacy_step
        self.variables: dict[str, PyTree] = {}
        self._suppress = False
        self._start(model)

    def _start(self, model: MjModel) -> None:
        self._load(model, mj.MjData(model))
        with self.suppress_physics_errors():
            self.after_reset()

    def _load(self, model: MjModel, data: MjData) -> None:
        self.model = ModelView(model)
        self.data = NativeView(data)
        self.named = Named(model, model, self.data.ptr)
        self._bindings: dict[Element | tuple[Element, ...], Binding | EmptyBinding] = {}
        self.images = Images(model)
        self.staleness = Staleness()
        self._warnings = self.data.ptr.warning.number
        self._warned = self._warnings.tobytes()

    @classmethod
    def from_mjcf_model(cls, model: Model) -> Physics:
        """Compile a model with all attached models."""
        return cls(model.compile())

    @classmethod
    def from_xml_string(cls, xml_string: str, assets: dict[str, bytes] | None = None) -> Physics:
        """Compile MJCF."""
        return cls(mj.MjModel.from_xml_string(xml_string, assets or {}))

    @classmethod
    def from_xml_path(cls, path: str) -> Physics:
        """Compile an MJCF file."""
        return cls(mj.MjModel.from_xml_path(str(path)))

    def reload_from_mjcf_model(self, model: Model) -> None:
        """Compile a model again and start from its initial state."""
        self._start(model.compile())

    def reload_from_xml_string(self, xml_string: str, assets: dict[str, bytes] | None = None) -> None:
        """Compile MJCF and start from its initial state."""
        self._start(mj.MjModel.from_xml_string(xml_string, assets or {}))

    def reload_from_xml_path(self, path: str) -> None:
        """Compile an MJCF file and start from its initial state."""
        self._start(mj.MjModel.from_xml_path(str(path)))

    # -- state

    def set_control(self, control: ArrayLike) -> None:
        np.copyto(self.data.ptr.ctrl, control)

    def _copied(self, array: np.ndarray) -> np.ndarray:
        return array.copy()

    def get_state(self, sig: int | None = None) -> np.ndarray:
        """Return positions, velocities and activations, shape ``(nq + nv + na,)``; with ``sig``, ``mj_getState``."""
        if sig is None:
            return np.asarray(super().get_state())
        state = np.empty(mj.mj_stateSize(self.model.ptr, sig))
        mj.mj_getState(self.model.ptr, self.data.ptr, state, sig)
        return state

    state = get_state

    def set_state(self, state: ArrayLike, sig: int | None = None) -> None:
        """Set the result of ``get_state``; raise UsageError for another shape."""
        if sig is None:
            super().set_state(state)
        else:
            mj.mj_setState(self.model.ptr, self.data.ptr, np.asarray(state, float), sig)

    def copy(self, share_model: bool = False) -> Physics:
        """Return an independent copy of the state, and of the model unless ``share_model``."""
        physics = object.__new__(type(self))
        physics.legacy_step, physics.variables, physics._suppress = self.legacy_step, dict(self.variables), False
        model = self.model.ptr if share_model else mj.MjModel.__copy__(self.model.ptr)
        data = mj.MjData(model)
        mj.mj_copyData(data, model, self.data.ptr)
        physics._load(model, data)
        return physics

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = type(self), self.model.ptr, self.data.ptr, self.legacy_step, self.variables
        return _restored, arguments

    # -- dynamics

    def step(self, nstep: int = 1) -> None:
        """Advance by a number of time steps; raise PhysicsError if MuJoCo warns."""
        model, data = self.model.ptr, self.data.ptr
        self._warned = self._warnings.tobytes()
        if not self.legacy_step:
            mj.mj_step(model, data, nstep)
        elif model.opt.integrator == _RK4:
            mj.mj_step(model, data, nstep)
            mj.mj_step1(model, data)
        else:  # positions and velocities are computed for this state already: finish the step, then prepare the next
            mj.mj_step2(model, data)
            if nstep > 1:
                mj.mj_step(model, data, nstep - 1)
            mj.mj_step1(model, data)
        self._check_warnings()

    def forward(self) -> None:
        self._warned = self._warnings.tobytes()
        mj.mj_forward(self.model.ptr, self.data.ptr)
        self.staleness.dirty = False
        self._check_warnings()

    def reset(self, keyframe_id: int | None = None) -> None:
        model, data = self.model.ptr, self.data.ptr
        if keyframe_id is None:
            mj.mj_resetData(model, data)
        else:
            self.check_keyframe(keyframe_id)
            mj.mj_resetDataKeyframe(model, data, keyframe_id)
        self.variables.clear()
        self.after_reset()

    def after_reset(self) -> None:
        """Compute all quantities without the actuators, because there are no controls yet."""
        with self.model.disable("actuation"):
            self.forward()

    @contextlib.contextmanager
    def reset_context(self) -> Iterator[Physics]:
        """Reset, let the block set the initial state, then compute all derived quantities."""
        with contextlib.suppress(PhysicsError):
            self.reset()
        yield self
        self.after_reset()

    @contextlib.contextmanager
    def suppress_physics_errors(self) -> Iterator[None]:
        before, self._suppress = self._suppress, True
        try:
            yield
        finally:
            self._suppress = before

    def _check_warnings(self) -> None:
        if self._warnings.tobytes() == self._warned:
            return
        before = np.frombuffer(self._warned, self._warnings.dtype)
        names = [n for n, new in zip(mj.mjtWarning.__members__, self._warnings > before, strict=False) if new]
        message = f"Physics state is invalid. Warning(s) raised: {', '.join(names)}"
        if not self._suppress:
            raise PhysicsError(message)
        _log.warning(message)

    # -- elements

    @property
    def is_dirty(self) -> bool:
        """Whether something was written through a binding after all quantities were last computed."""
        return self.staleness.dirty

    def mark_as_dirty(self) -> None:
        self.staleness.dirty = True

    def bind(self, elements: Elements) -> PyTree:
        """Return the attributes of an element, or of several of one kind; see ``BasePhysics.bind``.

        Bindings are cached: they know the indices of the attributes in MuJoCo's arrays.
        """
        key: Any = tuple(elements) if isinstance(elements, list) else elements
        try:
            return self._bindings[key]
        except (KeyError, TypeError):  # a new element, or a sequence without a hash
            sequence, single = as_elements(elements)
        key = sequence[0] if single else sequence
        if key not in self._bindings:
            self._bindings[key] = super().bind(key)
        return self._bindings[key]

    def _new_binding(self, kind: str, ids: tuple[int, ...], single: bool) -> Binding:
        return Binding(weakref.proxy(self), kind, ids, single)

    def fail(self, condition: ArrayLike = True) -> None:
        if np.any(condition):
            raise EpisodeInitializationError

    def recompute_constants(self) -> None:
        mj.mj_setConst(self.model.ptr, mj.MjData(self.model.ptr))  # mj_setConst would leave this state at the reference
        self.mark_as_dirty()

    def count_compensated(self) -> None:
        """Switch gravity compensation on in MuJoCo, if no body had any when the model was compiled."""
        model, before = self.model.ptr, copy.copy(self.model.ptr)
        mj.mj_setConst(model, mj.MjData(model))  # the only function that sets the number of compensated bodies
        for name, value in ((n, getattr(before, n)) for n in dir(before)):
            if isinstance(value, np.ndarray) and value.flags.writeable:
                getattr(model, name)[...] = value
        for name in ("meaninertia", "meanmass", "meansize", "extent", "center"):
            setattr(model.stat, name, getattr(before.stat, name))

    def render(
        self,
        height: int = 240,
        width: int = 320,
        camera_id: int | str = -1,
        *,
        depth: bool = False,
        segmentation: bool = False,
        scene_option: MjvOption | None = None,
        render_flag_overrides: Mapping[str | int, bool] | None = None,
        scene_callback: Callable[[Physics, MjvScene], None] | None = None,
    ) -> np.ndarray:
        """Return an image: uint8 ``(height, width, 3)``; float32 ``(height, width)`` [m]; int32 ``(.., .., 2)``.

        Args:
            height: Height of the image [pixels].
            width: Width of the image [pixels].
            camera_id: Number or name of one of the model's cameras; -1 is the free camera.
            segmentation: Return numbers and types (``mjtObj``) of objects instead; (-1, -1) is none.
            scene_option: The ``MjvOption`` of the image.
            render_flag_overrides: Flags of ``mjtRndFlag``, by name in small letters or by number -> value.
            scene_callback: Called with the physics and the ``MjvScene`` before it is drawn, to add shapes.
        """
        add = None if scene_callback is None else lambda scene: scene_callback(self, scene)
        data, chosen = self.data.ptr, (depth, segmentation, scene_option, render_flag_overrides, add)
        return self.images.draw(data, height, width, camera_id, *chosen)

    @property
    def contexts(self) -> None:
        """None: callers need not update rendering contexts."""
        return

    def free(self) -> None:
        """Drop the model and the state."""
        self.images.close()
        for binding in self._bindings.values():
            binding.free()
        self._bindings.clear()


def _restored(
    kind: type[Physics], model: MjModel, data: MjData, legacy_step: bool, variables: dict[str, PyTree]
) -> Physics:
    physics = object.__new__(kind)
    physics.legacy_step, physics.variables, physics._suppress = legacy_step, variables, False
    physics._load(model, data)
    return physics


class Place:
    """The place of an attribute of bound elements.

    Attributes:
        index: Its rows in the field.
        derived: Whether it is computed from other attributes, and out of date when they change.
        shown: The array that readers get; None if they get a number.
        plain: The memory of ``shown`` as a plain array.
    """

    __slots__ = ("array", "derived", "index", "plain", "shown")

    def __init__(self, array: np.ndarray, index: Index, derived: bool) -> None:
        self.array, self.derived = array, derived
        if isinstance(index, np.ndarray) and index.size and np.array_equal(index, index[0] + np.arange(index.size)):
            index = slice(int(index[0]), int(index[-1]) + 1)  # the same rows, several times faster
        self.index = index
        value = array[index]
        self.shown = None if value.ndim == 0 else value.copy().view(SyncedArray)
        self.plain = None if self.shown is None else self.shown.view(np.ndarray)


class SyncedArray(np.ndarray):
    """A copy of a part of a MuJoCo array: writing an item also writes to MuJoCo, and marks derived quantities.

    Reading it again through its binding gives the newest values.
    """

    # Slices of this array do not inherit these: writing to a slice has no effect on MuJoCo.
    _binding: Binding | None = None
    _name: str = ""

    def __array_wrap__(
        self, array: np.ndarray, context: tuple[Any, ...] | None = None, return_scalar: bool = False
    ) -> PyTree:
        """Return results of functions of this array as plain arrays: sums of products then take a third less time."""
        return array[()] if return_scalar else array

    def __setitem__(self, key: Index, value: object) -> None:
        binding = self._binding
        if binding is None:
            super().__setitem__(key, value)
            return
        value = np.array(value)  # the value may be a slice of this array: `array[1:] *= 2` changes it before this call
        getattr(binding, self._name)  # this updates the values here
        super().__setitem__(key, value)
        binding.write(self._name, np.asarray(self))

    def copy(self, order: Literal["K", "A", "C", "F"] | None = "C") -> np.ndarray:
        """Return a plain array."""
        return np.array(self, order=order, subok=False)

    def __copy__(self) -> np.ndarray:
        return self.copy()

    def __deepcopy__(self, memo: dict[int, object] | None) -> np.ndarray:
        return self.copy()

    def __reduce__(self) -> str | tuple[Any, ...]:
        raise NotImplementedError("a bound array cannot be pickled: copy it first")


class Binding(BaseBinding):
    """Bound elements on MuJoCo's C engine; see ``BaseBinding``. Writing an item of an array writes it to MuJoCo."""

    __slots__ = ("_places", "_staleness")
    _physics: Physics
    _places: dict[str, Place]
    _staleness: Staleness

    def __init__(self, physics: Physics, kind: str, ids: tuple[int, ...], single: bool) -> None:
        super().__init__(physics, kind, ids, single)
        object.__setattr__(self, "_places", {})
        object.__setattr__(self, "_staleness", physics.staleness)

    def _place(self, name: str) -> Place:
        """Return the place of an attribute, and keep it for the next access."""
        field, index = self.locate(name)
        holder = self._physics.model.ptr if field.struct == "model" else self._physics.data.ptr
        place = self._places[name] = Place(getattr(holder, field.name), index, not field.triggers)
        if place.shown is not None:
            place.shown._binding, place.shown._name = self, name
        return place

    def write(self, name: str, value: ArrayLike) -> None:
        place = self._places.get(name) or self._place(name)
        if not place.derived:
            self._staleness.dirty = True
        elif self._staleness.dirty:
            self._physics.forward()
        place.array[place.index] = value
        for other in layout.DISABLED_BY.get(self._fields[name].name, ()):
            getattr(self._physics.model.ptr, other)[list(self._ids)] = 0
        if name == "gravcomp" and not self._physics.model.ptr.ngravcomp:
            self._physics.count_compensated()

    def free(self) -> None:
        """Drop the references to MuJoCo's arrays."""
        self._places.clear()

    def read(self, name: str) -> PyTree:
        place = self._places.get(name) or self._place(name)
        if place.derived and self._staleness.dirty:
            self._physics.forward()
        if place.plain is None:
            return place.array[place.index]
        place.plain[...] = place.array[place.index]
        return place.shown

    def _plain(self, array: PyTree) -> np.ndarray:
        return np.asarray(array)
