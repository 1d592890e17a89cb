"""Supervisors: who restarts whom, when and how often; with pools, partitions, registries, jobs and programs."""

from .admin import ChangeSupervisor, ChildCounts, ChildInfo, CountChildren, EndedChild, EndedChildren, GetChildSpec
from .config import tree_from
from .dynamic import DynamicSupervisor
from .rules import Rule
from .services.awaited_jobs import Failed, Job, Ok
from .services.jobs import TaskSupervisor
from .services.partition import CountPartitions, PartitionSupervisor, ResizePartitions, Route, partition_of, partitions
from .services.pool import PoolInfo, PoolStatus, PoolSupervisor, ResizePool, pool, pool_of
from .services.program import Program, ProgramInfo, ProgramInput, ProgramStatus, program
from .services.program_lines import ProgramLine
from .services.registrar import KeyFreed, KeyRegistered, RegistryActor
from .services.registry import Registry, RegistryEntry, registry
from .services.tasks import Tasks, tasks
from .spec import Flags, check_children

__all__ = [
    "ChangeSupervisor",
    "ChildCounts",
    "ChildInfo",
    "CountChildren",
    "CountPartitions",
    "DynamicSupervisor",
    "EndedChild",
    "EndedChildren",
    "Failed",
    "Flags",
    "GetChildSpec",
    "Job",
    "KeyFreed",
    "KeyRegistered",
    "Ok",
    "PartitionSupervisor",
    "PoolInfo",
    "PoolStatus",
    "PoolSupervisor",
    "Program",
    "ProgramInfo",
    "ProgramInput",
    "ProgramLine",
    "ProgramStatus",
    "Registry",
    "RegistryActor",
    "RegistryEntry",
    "ResizePartitions",
    "ResizePool",
    "Route",
    "Rule",
    "TaskSupervisor",
    "Tasks",
    "check_children",
    "partition_of",
    "partitions",
    "pool",
    "pool_of",
    "program",
    "registry",
    "tasks",
    "tree_from",
]
