"""The policy bundle and its runner: numpy and onnxruntime only, no JAX."""

from sim2real.policy.bundle import PolicyReference as PolicyReference
from sim2real.policy.bundle import load_bundle as load_bundle
from sim2real.policy.bundle import read_weights as read_weights
from sim2real.policy.bundle import save_bundle as save_bundle
from sim2real.policy.contract import ActionTerm as ActionTerm
from sim2real.policy.contract import NetworkSpec as NetworkSpec
from sim2real.policy.contract import ObservationTerm as ObservationTerm
from sim2real.policy.contract import PolicyContract as PolicyContract
from sim2real.policy.runner import BlendedRunner as BlendedRunner
from sim2real.policy.runner import PolicyRunner as PolicyRunner
from sim2real.policy.runner import UprightRunner as UprightRunner
