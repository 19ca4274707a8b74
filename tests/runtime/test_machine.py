"""What the processor file says."""

from __future__ import annotations

from runtime.machine import package_version, parse_cpu_info, processor

X86 = """processor\t: 0
model name\t: Some CPU @ 2.0GHz
flags\t\t: fpu sse2 avx2 avx512f avx512_vnni

processor\t: 1
model name\t: Some CPU @ 2.0GHz
flags\t\t: fpu
"""
ARM = "processor\t: 0\nFeatures\t: fp asimd crc32 asimddp\nCPU part\t: 0xd0b\n"


def test_no_file() -> None:
    found = parse_cpu_info("", machine="arm64", cores=4)
    assert (found.model, found.flags, found.has_int8_dot_products) == ("arm64", None, False)


def test_x86() -> None:
    found = parse_cpu_info(X86, machine="x86_64", cores=2)
    assert (found.model, found.flags) == ("Some CPU @ 2.0GHz", ("avx2", "avx512f", "avx512_vnni"))
    assert found.has_int8_dot_products


def test_arm() -> None:
    found = parse_cpu_info(ARM, machine="aarch64", cores=4)
    assert found.flags == ("asimd", "asimddp")
    assert found.has_int8_dot_products


def test_this_machine() -> None:
    assert processor().cores >= 1
    assert package_version("numpy") is not None
    assert package_version("no-such-distribution-at-all") is None
