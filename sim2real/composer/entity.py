"""Entities: the parts that a world is made of."""

from __future__ import annotations

import logging
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sim2real.arrays import multiply_quaternions, namespace, rotate
from sim2real.composer.errors import NotAttachedError
from sim2real.composer.mjcf import RootElement as Model
from sim2real.composer.mjcf import get_attachment_frame, get_frame_freejoint
from sim2real.composer.mjcf.element import Element
from sim2real.composer.observables import Observables
from sim2real.errors import UsageError

if TYPE_CHECKING:
    from sim2real.composer.observation.observable.base import Observable
    from sim2real.composer.physics.base import BasePhysics
    from sim2real.composer.types import Array, ArrayLike, Hook, MjSpec, RandomState
    from sim2real.types import PyTree

_log = logging.getLogger(__name__)


class FreePropObservableMixin(ABC):
    """Observables that a free-moving object must have."""

    @property
    @abstractmethod
    def position(self) -> Observable:
        """Position ``(3,)`` [m]."""

    @property
    @abstractmethod
    def orientation(self) -> Observable:
        """Quaternion ``(4,)``, scalar first."""

    @property
    @abstractmethod
    def linear_velocity(self) -> Observable:
        """Velocity ``(3,)`` [m/s]."""

    @property
    @abstractmethod
    def angular_velocity(self) -> Observable:
        """Angular velocity ``(3,)`` [rad/s]."""


class WithHooks(ABC):  # noqa: B024
    """Hooks of entities and tasks, called at fixed times of an episode; they do nothing unless overridden."""

    def initialize_episode_mjcf(self, random_state: RandomState) -> None:  # noqa: B027
        """Change the models before they are compiled for an episode."""

    def after_compile(self, physics: BasePhysics, random_state: RandomState) -> None:  # noqa: B027
        """Look at the compiled model."""

    def initialize_episode(self, physics: BasePhysics, random_state: RandomState) -> None:  # noqa: B027
        """Set the state at the start of an episode."""

    def after_substep(self, physics: BasePhysics, random_state: RandomState) -> None:  # noqa: B027
        """Act after a step of the physics."""

    def after_step(self, physics: BasePhysics, random_state: RandomState) -> None:  # noqa: B027
        """Act after a control step."""


class Entity(WithHooks):
    """A part of a world: a model, observables, and hooks that run at fixed times of an episode.

    Subclasses override ``_build``, not the constructor.

    Args:
        observable_options: Passed on to ``Observables.set_options``.
    """

    def __init__(self, *args: PyTree, observable_options: dict[str, PyTree] | None = None, **kwargs: PyTree) -> None:
        self._post_init_hooks: list[Hook] = []
        self._parent: weakref.ref[Entity] | None = None
        self._attached: list[Entity] = []
        self._default_model: Model | None = None
        self._build(*args, **kwargs)
        self._observables = self._build_observables()
        self._observables.set_options(observable_options)

    @abstractmethod
    def _build(self, *args: PyTree, **kwargs: PyTree) -> None:
        """Make the model."""

    def _build_observables(self) -> Observables:
        """Return the observables; default: those that methods of the entity declare."""
        return Observables(self)

    @property
    def mjcf_model(self) -> Model:
        """The model; at first an empty one, unless a subclass makes another."""
        if self._default_model is None:
            self._default_model = self._make_model()
        return self._default_model

    def _make_model(self) -> Model:
        return Model()

    @property
    def name(self) -> str:
        """The model's name."""
        return self.mjcf_model.model

    @property
    def observables(self) -> Observables:
        """The observables of this entity."""
        return self._observables

    @property
    def parent(self) -> Entity | None:
        """The entity to which this one is attached, or None."""
        return self._parent() if self._parent else None

    @property
    def attachment_site(self) -> Model | Element:
        """Default place for other entities: a site or the model."""
        return self.mjcf_model

    @property
    def root_body(self) -> Element:
        """The body that holds this entity: the attachment frame, or the world."""
        return get_attachment_frame(self.mjcf_model) if self.parent else self.mjcf_model.worldbody

    def iter_entities(self, exclude_self: bool = False) -> Iterator[Entity]:
        """Yield this entity and all below it: depth first, in the order of attachment."""
        if not exclude_self:
            yield self
        for entity in self._attached:
            yield from entity.iter_entities()

    def attach(self, entity: Entity, attach_site: Model | Element | None = None) -> Element:
        """Attach another entity without degrees of freedom; return its frame, to which joints may be added.

        Args:
            attach_site: A site of this entity's model; default: its world.
        """
        frame = (self.attachment_site if attach_site is None else attach_site).attach(entity.mjcf_model)
        self._attached.append(entity)
        entity._parent = weakref.ref(self)
        return frame

    def detach(self) -> None:
        """Detach this entity from its parent, together with the entities below it.

        Raises:
            NotAttachedError: It has no parent.
        """
        if self._parent is None:
            raise NotAttachedError("Cannot detach an entity that is not attached.")
        parent = self._parent()
        if parent is not None:
            self.mjcf_model.detach()
            parent._attached.remove(self)
        self._parent = None

    # -- hooks, which get the action only if they have a third parameter

    def before_step(self, physics: BasePhysics, random_state: RandomState) -> None:
        """Act before a control step."""

    def before_substep(self, physics: BasePhysics, random_state: RandomState) -> None:
        """Act before a step of the physics."""

    # -- poses and frames

    def global_vector_to_local_frame(self, physics: BasePhysics, vec_in_world_frame: ArrayLike) -> Array:
        """Return vectors of the world, shape ``(..., 3)`` or ``(..., 2)``, in this entity's axes; same shape.

        Raises:
            UsageError: The last axis has another size.
        """
        xp = namespace(vec_in_world_frame, physics.bind(self.root_body).xmat)
        vector = xp.asarray(vec_in_world_frame)
        size = vector.shape[-1] if vector.ndim else 0
        if size not in (2, 3):
            raise UsageError(f"`vec_in_world_frame` should have shape with final dimension 2 or 3: got {vector.shape}")
        xmat = xp.reshape(xp.asarray(physics.bind(self.root_body).xmat), (3, 3))
        return xp.dot(vector, xmat[:size, :size])

    def global_xmat_to_local_frame(self, physics: BasePhysics, xmat: ArrayLike) -> Array:
        """Return a rotation of the world, shape ``(3, 3)`` or ``(9,)``, seen from this entity; same shape.

        Raises:
            UsageError: The shape is another.
        """
        frame = physics.bind(self.root_body).xmat
        xp = namespace(xmat, frame)
        matrix = xp.asarray(xmat)
        if matrix.shape not in ((3, 3), (9,)):
            raise UsageError(f"`xmat` should have shape (3, 3) or (9,): got {matrix.shape}")
        return xp.reshape(xp.reshape(xp.asarray(frame), (3, 3)).T @ xp.reshape(matrix, (3, 3)), matrix.shape)

    def _pose_holder(self) -> tuple[Element, bool]:
        """Return the free joint or the frame that has the pose, and whether it is a free joint."""
        if self.mjcf_model.parent_model is None:
            raise NotAttachedError("No attachment frame found.", hint="only an attached entity has a pose")
        joint = get_frame_freejoint(self.mjcf_model)
        return (get_attachment_frame(self.mjcf_model), False) if joint is None else (joint, True)

    def get_pose(self, physics: BasePhysics) -> tuple[Array, Array]:
        """Return position ``(3,)`` [m] and quaternion ``(4,)``: in the world with a free joint, else in the parent."""
        holder, free = self._pose_holder()
        bound = physics.bind(holder)
        return (bound.qpos[:3], bound.qpos[3:]) if free else (bound.pos, bound.quat)

    def set_pose(
        self, physics: BasePhysics, position: ArrayLike | None = None, quaternion: ArrayLike | None = None
    ) -> None:
        """Set position and quaternion: in the world with a free joint, else in the parent.

        Args:
            position: ``(3,)`` [m]; None: unchanged.
            quaternion: ``(4,)``, scalar first; None: unchanged.
        """
        holder, free = self._pose_holder()
        if quaternion is not None:
            xp = namespace(quaternion)
            quaternion = xp.asarray(quaternion) / xp.linalg.norm(xp.asarray(quaternion))
        if free:
            if position is not None:
                physics.write(holder, "qpos", position, slice(0, 3))
            if quaternion is not None:
                physics.write(holder, "qpos", quaternion, slice(3, 7))
            return
        if position is not None:
            physics.set(holder, "pos", position)
        if quaternion is not None:
            physics.set(holder, "quat", quaternion)

    def shift_pose(
        self,
        physics: BasePhysics,
        position: ArrayLike | None = None,
        quaternion: ArrayLike | None = None,
        rotate_velocity: bool = False,
    ) -> None:
        """Shift and turn the present pose.

        Args:
            position: Shift, ``(3,)`` [m].
            quaternion: Turn, ``(4,)``, applied after the present orientation.
            rotate_velocity: Whether to turn the linear velocity, too; the angular velocity is in the local frame.
        """
        old_position, old_quaternion = self.get_pose(physics)
        new_position = new_quaternion = None
        if position is not None:
            xp = namespace(position, old_position)
            new_position = xp.asarray(old_position) + xp.asarray(position)
        if quaternion is not None:
            xp = namespace(quaternion, old_quaternion)
            turn = xp.asarray(quaternion, dtype=float)
            new_quaternion = multiply_quaternions(turn, xp.asarray(old_quaternion))
            if rotate_velocity and self._pose_holder()[1]:
                self.set_velocity(physics, rotate(xp.asarray(self.get_velocity(physics)[0]), turn))
        self.set_pose(physics, new_position, new_quaternion)

    def get_velocity(self, physics: BasePhysics) -> tuple[Array, Array]:
        """Return linear ``(3,)`` [m/s] and angular velocity ``(3,)`` [rad/s, local frame].

        Raises:
            UsageError: The entity has no free joint.
        """
        holder, free = self._pose_holder()
        if not free:
            raise UsageError("get_velocity cannot be used on a non-free entity")
        qvel = physics.bind(holder).qvel
        return qvel[:3], qvel[3:]

    def set_velocity(
        self, physics: BasePhysics, velocity: ArrayLike | None = None, angular_velocity: ArrayLike | None = None
    ) -> None:
        """Set linear and angular velocity; warns if there is no free joint.

        Args:
            velocity: Linear velocity ``(3,)`` [m/s]; None: unchanged.
            angular_velocity: ``(3,)`` [rad/s, local frame]; None: unchanged.
        """
        holder, free = self._pose_holder()
        if not free:
            _log.warning("Cannot set velocity on Entity with no free joint.")
            return
        if velocity is not None:
            physics.write(holder, "qvel", velocity, slice(0, 3))
        if angular_velocity is not None:
            physics.write(holder, "qvel", angular_velocity, slice(3, 6))

    def configure_joints(self, physics: BasePhysics, position: ArrayLike) -> None:
        """Set the positions of this entity's joints, including frame joints of its children."""
        physics.set(self.mjcf_model.find_all("joint", exclude_attachments=True), "qpos", position)


class ModelWrapperEntity(Entity):
    """An entity around a model, without any logic."""

    def _build(self, mjcf_model: Model | MjSpec) -> None:
        if not isinstance(mjcf_model, Model):
            mjcf_model.compile()  # MuJoCo writes only compiled specs
            mjcf_model = Model.from_xml_string(mjcf_model.to_xml(), mjcf_model.assets)
        self._mjcf_model = mjcf_model

    @property
    def mjcf_model(self) -> Model:
        """The model."""
        return self._mjcf_model

    @property
    def joints(self) -> list[Element]:
        """The model's own joints."""
        return self.mjcf_model.find_all("joint", exclude_attachments=True)

    @property
    def actuators(self) -> list[Element]:
        """The model's own actuators."""
        return self.mjcf_model.find_all("actuator", exclude_attachments=True)
