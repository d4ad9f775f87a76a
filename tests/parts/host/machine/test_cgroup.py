"""Limits found in fake v1 and v2 trees, and real groups where this user may make them."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support.waiting import until
from zsched.core.values.errors import AdapterError
from zsched.host.machine.cgroup import (
    CgroupTree,
    CpuQuota,
    parse_flat,
    parse_membership,
    parse_mounts,
)
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.paper.work_group import OWN, WORK

V2 = "30 25 0:26 / /sys/fs/cgroup rw,nosuid shared:9 - cgroup2 cgroup2 rw,nsdelegate\n"
V1 = (
    "33 31 0:29 / /sys/fs/cgroup/cpu,cpuacct rw,relatime - cgroup cgroup rw,cpu,cpuacct\n"
    "35 31 0:32 / /sys/fs/cgroup/memory rw,relatime - cgroup cgroup rw,memory\n"
    "40 31 0:37 / /sys/fs/cgroup/systemd rw,relatime - cgroup cgroup rw,name=systemd\n"
)


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / name.lstrip("/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def tree(root: Path, mountinfo: str, membership: str, groups: dict[str, str]) -> CgroupTree:
    write(root, {"/proc/self/mountinfo": mountinfo, "/proc/self/cgroup": membership})
    write(root, {f"/sys/fs/cgroup/{name}": text for name, text in groups.items()})
    return CgroupTree(root)


def test_mounts_are_parsed_with_escapes_and_other_lines_left_out() -> None:
    text = "1 0 8:1 / / rw - ext4 /dev/vda rw\nnonsense\n5 1 0:9 /a\\040b /mnt/c\\134d rw - cgroup none rw,cpu\n" + V2
    v1, v2 = parse_mounts(text)
    assert (v1.point, v1.root, v1.is_v2) == (Path("/mnt/c\\d"), "/a b", False)
    assert "cpu" in v1.controllers
    assert (v2.point, v2.is_v2) == (Path("/sys/fs/cgroup"), True)


def test_membership_is_parsed_with_colons_in_names() -> None:
    assert parse_membership("4:cpu,cpuacct:/a:b\n1:name=systemd:/s\n0::/c\nnonsense\n") == {
        "cpu": "/a:b",
        "cpuacct": "/a:b",
        "name=systemd": "/s",
        "": "/c",
    }


def test_flat_files_skip_what_is_no_number() -> None:
    assert parse_flat("usage_usec 12\nbad\nx max\ny -1\n") == {"usage_usec": 12}


def test_smallest_ancestor_wins_in_v2(tmp_path: Path) -> None:
    groups = {
        "a/cpu.max": "50000 100000\n",
        "a/cpu.stat": "usage_usec 2500000\nuser_usec 1\n",
        "a/b/cpu.max": "max 100000\n",
        "a/b/c/cpu.max": "200000 100000\n",
        "a/b/memory.max": "1073741824\n",
        "a/b/c/memory.max": "max\n",
        "a/memory.high": "536870912\n",
        "a/memory.current": "209715200\n",
        "a/memory.stat": "anon 1\ninactive_file 104857600\n",
    }
    found = tree(tmp_path, V2, "0::/a/b/c\n", groups)
    cpu, memory = found.cpu_quota(), found.memory_quota()
    assert cpu is not None
    assert memory is not None
    assert (cpu.cores, cpu.folder.name, cpu.used_s()) == (0.5, "a", 2.5)
    assert (memory.limit_mb, memory.folder.name, memory.used_mb()) == (512.0, "a", 100.0)


def test_smallest_ancestor_wins_in_v1(tmp_path: Path) -> None:
    groups = {
        "cpu,cpuacct/cpu.cfs_quota_us": "-1\n",
        "cpu,cpuacct/docker/x/cpu.cfs_quota_us": "150000\n",
        "cpu,cpuacct/docker/x/cpu.cfs_period_us": "100000\n",
        "cpu,cpuacct/docker/x/cpuacct.usage": "3000000000\n",
        "memory/docker/x/memory.limit_in_bytes": "9223372036854771712\n",
        "memory/docker/memory.limit_in_bytes": "268435456\n",
        "memory/docker/memory.usage_in_bytes": "134217728\n",
        "memory/docker/memory.stat": "inactive_file 1\ntotal_inactive_file 67108864\n",
    }
    found = tree(tmp_path, V1, "8:cpu,cpuacct:/docker/x\n4:memory:/docker/x\n0::/\n", groups)
    cpu, memory = found.cpu_quota(), found.memory_quota()
    assert cpu is not None
    assert memory is not None
    assert (cpu.cores, cpu.used_s()) == (1.5, 3.0)
    assert (memory.limit_mb, memory.used_mb()) == (256.0, 64.0)


def test_container_without_namespace_sees_its_group_at_the_mount(tmp_path: Path) -> None:
    mounts = "33 31 0:29 /docker/x /sys/fs/cgroup rw - cgroup2 cgroup rw\n"
    found = tree(tmp_path, mounts, "0::/docker/x\n", {"cpu.max": "30000 100000", "cpu.stat": "usage_usec 7"})
    cpu = found.cpu_quota()
    assert cpu is not None
    assert cpu.cores == pytest.approx(0.3)


def test_accounting_in_a_hierarchy_of_its_own_is_matched_by_name(tmp_path: Path) -> None:
    mounts = (
        "1 0 0:1 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n"
        "2 0 0:2 / /sys/fs/cgroup/cpuacct rw - cgroup cgroup rw,cpuacct\n"
    )
    groups = {
        "cpu/a/node/cpu.cfs_quota_us": "1000",
        "cpu/a/node/cpu.cfs_period_us": "10000",
        "cpuacct/node/cpuacct.usage": "5000000000",
    }
    quota = tree(tmp_path, mounts, "1:cpu:/a/node\n2:cpuacct:/node\n", groups).cpu_quota()
    assert quota is not None
    assert (quota.cores, quota.used_s()) == (0.1, 5.0)


@pytest.mark.parametrize("membership", ["0::/../outside\n", "", "0::/gone\n", "garbage"])
def test_no_group_or_a_strange_one_is_no_limit(tmp_path: Path, membership: str) -> None:
    found = tree(tmp_path, V2, membership, {"cpu.max": "max 100000"})
    assert found.cpu_quota() is None
    assert found.memory_quota() is None


V2_GROUPS = {
    "cgroup.controllers": "cpu memory pids\n",
    "cgroup.subtree_control": "memory\n",
    "cgroup.procs": "1\n",  # the root group may have both processes and limited children
    "user/cgroup.type": "domain\n",
    "user/cgroup.controllers": "memory pids\n",
    "user/cgroup.procs": "",
    "user/session/cgroup.type": "domain\n",
    "user/session/cgroup.controllers": "cpu memory\n",
    "user/session/cgroup.procs": "77\n",
}


def test_v2_group_is_made_in_the_nearest_ancestor_that_may_have_it(tmp_path: Path) -> None:
    found = tree(tmp_path, V2, "0::/user/session\n", V2_GROUPS)
    top = tmp_path / "sys/fs/cgroup"
    group = LimitedGroup.create("edge1", cpu_cores=0.5, memory_mb=64, tree=found)
    assert group.folders == (top / "edge1",)
    assert (top / "edge1/cpu.max").read_text() == "10000 20000"
    assert (top / "edge1/memory.max").read_text() == str(64 * 2**20)
    assert (top / "user/cgroup.subtree_control").exists() is False
    only_memory = LimitedGroup.create("edge2", memory_mb=64, tree=found)
    assert only_memory.folders == (top / "user/edge2",)
    assert (top / "user/cgroup.subtree_control").read_text() == "+memory"


def test_v2_group_without_a_place_is_refused_with_advice(tmp_path: Path) -> None:
    groups = V2_GROUPS | {"cgroup.controllers": "pids\n", "user/cgroup.controllers": "pids\n"}
    found = tree(tmp_path, V2, "0::/user/session\n", groups)
    with pytest.raises(AdapterError, match="systemd-run --user"):
        LimitedGroup.create("edge1", cpu_cores=0.5, tree=found)
    with pytest.raises(AdapterError, match="no cpu control groups"):
        LimitedGroup.create("edge1", cpu_cores=0.5, tree=CgroupTree(tmp_path / "nowhere"))


def test_a_group_that_gives_way_is_of_the_idle_class_and_keeps_its_quota() -> None:
    reason = LimitedGroup.why_not()
    if reason is not None:
        pytest.skip(reason)
    group = LimitedGroup.create(f"zsched-test-way-{os.getpid()}", cpu_cores=0.25, memory_mb=64)
    try:
        files = [folder / "cpu.idle" for folder in group.folders if (folder / "cpu.idle").exists()]
        if not files:
            pytest.skip("groups have no class here (Linux < 5.15)")
        assert [file.read_text().strip() for file in files] == ["0"]
        group.give_way()
        assert [file.read_text().strip() for file in files] == ["1"]
        inner = group.inner("work", cpu_cores=0.125)
        inner.remove()
        with subprocess.Popen(["sleep", "60"]) as idle:
            try:
                group.add(idle.pid)
                quota = CgroupTree(pid=str(idle.pid)).cpu_quota()
                assert quota is not None
                assert quota.cores == 0.25
            finally:
                idle.kill()
    finally:
        group.remove()


def test_real_group_is_made_limits_a_process_and_is_removed() -> None:
    reason = LimitedGroup.why_not()
    if reason is not None:
        pytest.skip(reason)
    group = LimitedGroup.create(f"zsched-test-group-{os.getpid()}", cpu_cores=0.25, memory_mb=64)
    try:
        with subprocess.Popen(["sh", "-c", "while :; do :; done"]) as busy:
            try:
                group.add(busy.pid)
                quota = CgroupTree(pid=str(busy.pid)).cpu_quota()
                memory = CgroupTree(pid=str(busy.pid)).memory_quota()
                assert quota is not None
                assert memory is not None
                assert (quota.cores, memory.limit_mb) == (0.25, 64.0)
                begin_s, begin = time.monotonic(), quota.used_s()
                assert begin is not None
                end = until(lambda: (used := quota.used_s() or 0.0) > begin + 0.2 and used, "it works")
                assert (end - begin) / (time.monotonic() - begin_s) < 0.35
                with pytest.raises(AdapterError, match=str(busy.pid)):
                    group.remove()
            finally:
                busy.kill()
    finally:
        group.remove()
    assert not any(folder.exists() for folder in group.folders)


def test_a_group_within_another_has_a_quota_of_its_own_and_its_node_is_the_outer_one() -> None:
    """As a node of the lab whose tasks are not to have what zsched leaves; a worker goes there by itself."""
    if (reason := LimitedGroup.why_not(memory=False)) is not None:
        pytest.skip(reason)
    outer = LimitedGroup.create(f"zsched-test-outer-{os.getpid()}", cpu_cores=0.5)
    own, work = outer.inner(OWN), outer.inner(WORK, cpu_cores=0.2)
    try:
        with pytest.raises(AdapterError, match=WORK):
            outer.inner(WORK, cpu_cores=0.2)
        with subprocess.Popen(["sleep", "60"]) as child:
            try:
                own.add(child.pid)
                quota = CgroupTree(pid=str(child.pid)).cpu_quota()
                assert quota is not None
                assert (quota.cores, quota.folder.name) == (0.5, outer.folders[0].name)
            finally:
                child.kill()
        script = f"read _; exec {sys.executable} -m zsched_lab.paper.work_group timeit -n 1 -r 1 'while True: pass'"
        with subprocess.Popen(["sh", "-c", script], stdin=subprocess.PIPE) as busy:
            try:
                own.add(busy.pid)
                assert busy.stdin is not None
                busy.stdin.write(b"go\n")
                busy.stdin.flush()
                until(lambda: work.pids() == (busy.pid,), "it is in the tasks' group")

                def counted() -> CpuQuota | None:
                    """Its quota, once it is in the group that counts, too: it joins one hierarchy after the other."""
                    found = CgroupTree(pid=str(busy.pid)).cpu_quota()
                    return found if found is not None and found.used_s() is not None else None

                quota = until(counted, "its use is counted")
                assert quota is not None
                assert quota.cores == 0.2
                begin_s, begin = time.monotonic(), quota.used_s()
                assert begin is not None
                end = until(lambda: (used := quota.used_s() or 0.0) > begin + 0.2 and used, "it works")
                assert (end - begin) / (time.monotonic() - begin_s) < 0.3
            finally:
                busy.kill()
    finally:
        for group in (work, own, outer):
            group.remove()
    assert not any(folder.exists() for folder in (*outer.folders, *work.folders))


def test_group_that_exists_is_refused_and_left_alone() -> None:
    if (reason := LimitedGroup.why_not(memory=False)) is not None:
        pytest.skip(reason)
    name = f"zsched-test-twice-{os.getpid()}"
    group = LimitedGroup.create(name, cpu_cores=1.0)
    try:
        with pytest.raises(AdapterError, match=name):
            LimitedGroup.create(name, cpu_cores=1.0)
        assert all(folder.exists() for folder in group.folders)
        with pytest.raises(AdapterError, match="999999999"):
            group.add(999999999)
    finally:
        group.remove()
