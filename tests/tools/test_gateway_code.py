"""The C code for a gateway: compiled, it makes the frames that the node makes, and believes those of the host."""

from __future__ import annotations

import random
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from emb_runtime.can import e2e
from emb_runtime.can.messages import StopReason, load_layout
from emb_runtime.records import CurrentCommand, Frame, NodeState
from tools.gateway_code import gateway_code

LAYOUT = load_layout()
CASES = 200

PROGRAM = """
#include <stdio.h>
#include "emb.h"
#include "emb_e2e.h"

static void show(const uint8_t *data, size_t size)
{
    for (size_t i = 0; i < size; i++) printf("%02x", data[i]);
    printf("\\n");
}

int main(void)
{
    char kind;
    while (scanf(" %c", &kind) == 1) {
        uint8_t data[8] = {0};
        double v[5] = {0};
        if (kind == 'a') {
            struct emb_emb_angle_t m = {0};
            if (scanf("%lf %lf %lf", v, v + 1, v + 2) != 3) return 1;
            m.counter = emb_emb_angle_counter_encode(v[0]);
            m.angle = emb_emb_angle_angle_encode(v[1]);
            m.device_time = emb_emb_angle_device_time_encode(v[2]);
            emb_emb_angle_pack(data, &m, sizeof data);
            emb_protect(EMB_ANGLE_CRC_START, data, EMB_EMB_ANGLE_LENGTH);
            show(data, EMB_EMB_ANGLE_LENGTH);
        } else if (kind == 'v') {
            struct emb_emb_velocity_t m = {0};
            if (scanf("%lf %lf %lf %lf %lf", v, v + 1, v + 2, v + 3, v + 4) != 5) return 1;
            m.counter = emb_emb_velocity_counter_encode(v[0]);
            m.velocity = emb_emb_velocity_velocity_encode(v[1]);
            m.applied_current = emb_emb_velocity_applied_current_encode(v[2]);
            m.node_state = emb_emb_velocity_node_state_encode(v[3]);
            m.command_counter = emb_emb_velocity_command_counter_encode(v[4]);
            emb_emb_velocity_pack(data, &m, sizeof data);
            emb_protect(EMB_VELOCITY_CRC_START, data, EMB_EMB_VELOCITY_LENGTH);
            show(data, EMB_EMB_VELOCITY_LENGTH);
        } else if (kind == 's') {
            struct emb_emb_status_t m = {0};
            if (scanf("%lf %lf %lf %lf %lf", v, v + 1, v + 2, v + 3, v + 4) != 5) return 1;
            m.counter = emb_emb_status_counter_encode(v[0]);
            m.node_state = emb_emb_status_node_state_encode(v[1]);
            m.protocol_version = EMB_PROTOCOL_VERSION;
            m.stop_reason = emb_emb_status_stop_reason_encode(v[2]);
            m.rejected_commands = emb_emb_status_rejected_commands_encode(v[3]);
            m.bench_identity = emb_emb_status_bench_identity_encode(v[4]);
            emb_emb_status_pack(data, &m, sizeof data);
            emb_protect(EMB_STATUS_CRC_START, data, EMB_EMB_STATUS_LENGTH);
            show(data, EMB_EMB_STATUS_LENGTH);
        } else {
            struct emb_emb_command_t m = {0};
            for (size_t i = 0; i < EMB_EMB_COMMAND_LENGTH; i++)
                if (scanf("%2hhx", data + i) != 1) return 1;
            if (!emb_is_valid(EMB_COMMAND_CRC_START, EMB_COMMAND_RESERVED, data, EMB_EMB_COMMAND_LENGTH)
                || emb_emb_command_unpack(&m, data, EMB_EMB_COMMAND_LENGTH)
                || !emb_emb_command_current_is_in_range(m.current)
                || !emb_emb_command_answers_is_in_range(m.answers))
                printf("rejected\\n");
            else
                printf("%u %u %.4f %u\\n", m.counter, m.answers, emb_emb_command_current_decode(m.current), m.enable);
        }
    }
    return 0;
}
"""

Talk = Callable[[list[str]], list[str]]


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Talk:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler")
    folder: Path = tmp_path_factory.mktemp("gateway")
    for name, text in {**gateway_code(LAYOUT), "gateway.c": PROGRAM}.items():
        (folder / name).write_text(text)
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror"]
    sources = [str(folder / "emb.c"), str(folder / "gateway.c")]
    subprocess.run([compiler, *strict, *sources, "-o", str(folder / "gateway"), "-lm"], check=True)

    def talk(lines: list[str]) -> list[str]:
        said = subprocess.run(
            [folder / "gateway"], input="\n".join(lines), capture_output=True, text=True, check=True, timeout=60
        )
        return said.stdout.splitlines()

    return talk


def test_the_frames_of_the_gateway_are_those_of_the_node(gateway: Talk) -> None:
    draw, lines, frames = random.Random(1), list[str](), list[Frame]()
    for _ in range(CASES):
        counter, angle, ticks = draw.randrange(15), draw.uniform(-160, 160), draw.randrange(1 << 24)
        lines.append(f"a {counter} {angle!r} {ticks * 250e-9!r}")
        frames.append(LAYOUT.encode_angle(counter, angle, ticks * 250))
        velocity, applied = draw.uniform(-800, 800), draw.uniform(-20, 20)
        state, obeyed = draw.choice(list(NodeState)), draw.randrange(16)
        lines.append(f"v {counter} {velocity!r} {applied!r} {int(state)} {obeyed}")
        frames.append(LAYOUT.encode_velocity(counter, velocity, applied, state, obeyed))
        reason, rejected, bench = draw.choice(list(StopReason)), draw.randrange(1 << 16), draw.randrange(1 << 16)
        lines.append(f"s {counter} {int(state)} {int(reason)} {rejected} {bench}")
        frames.append(LAYOUT.encode_status(counter, state, reason, rejected, bench))
    assert gateway(lines) == [frame.data.hex() for frame in frames]


def test_the_gateway_obeys_what_the_host_sends_and_nothing_with_a_bit_that_is_wrong(gateway: Talk) -> None:
    draw, lines, expected = random.Random(2), list[str](), list[str]()
    for _ in range(CASES):
        taken = CurrentCommand(draw.randrange(15), draw.randrange(15), draw.randrange(-30_000, 30_001) * 2e-4, True)
        frame = LAYOUT.encode_command(*taken)
        lines.append(f"c {frame.data.hex()}")
        expected.append(f"{taken.counter} {taken.answers} {taken.current:.4f} 1")
        for _ in range(2):
            flips = sum(1 << bit for bit in draw.sample(range(40), draw.choice((1, 2))))
            lines.append(f"c {int.from_bytes(frame.data, 'big') ^ flips:010x}")
            expected.append("rejected")
    assert gateway(lines) == expected


def test_a_command_that_contradicts_the_layout_is_rejected_though_its_crc_is_right(gateway: Talk) -> None:
    def protected(body: bytes) -> str:
        return f"c {e2e.crc(LAYOUT.command.crc_start, body):02x}{body.hex()}"

    beyond = (30_001).to_bytes(2, "little")
    bodies = [b"\x00" + beyond + b"\x01", b"\x0f\x00\x00\x01", b"\xf0\x00\x00\x01", b"\x00\x00\x00\x03"]
    assert gateway([protected(body) for body in bodies]) == ["rejected"] * 4
    assert gateway([protected(b"\x21\x00\x00\x00")]) == ["1 2 0.0000 0"]
