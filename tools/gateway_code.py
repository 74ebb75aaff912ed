"""C code of the messages of ``emb.dbc``, for a gateway that speaks them beside a drive.

    python -m tools.gateway_code FOLDER

writes ``emb.h`` and ``emb.c``, which cantools generates: the node's messages packed, the host's unpacked; and
``emb_e2e.h``, what a DBC does not say: CRC, alive counter, reserved bits. C99, no library but the standard one.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cantools.database.can.c_source import generate

from emb_runtime.can.codec import parse
from emb_runtime.can.e2e import COUNTER_MODULUS
from emb_runtime.can.messages import Layout, load_layout

NAME = "emb"
NODE = "EMB_Node"

_E2E = """\
/* End-to-end protection of the messages of emb.dbc, protocol {protocol}: byte 0 is the CRC-8 SAE J1850 (AUTOSAR E2E
 * profile 1) of the message's data id and bytes 1 and up, the low half of byte 1 an alive counter. Made by
 * tools/gateway_code.py. */
#ifndef EMB_E2E_H
#define EMB_E2E_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define EMB_PROTOCOL_VERSION ({protocol}u)
/* Alive counters run 0..{last}. */
#define EMB_COUNTER_MODULUS ({modulus}u)

/* Of each message: the CRC after its data id, and the bits that no signal covers, as a little-endian word. */
{messages}

static inline uint8_t emb_crc(uint8_t state, const uint8_t *data, size_t size)
{{
    for (size_t i = 0; i < size; i++) {{
        state ^= data[i];
        for (int bit = 0; bit < 8; bit++)
            state = (uint8_t)((state & 0x80u) ? ((unsigned)state << 1) ^ 0x1Du : (unsigned)state << 1);
    }}
    return state;
}}

/* Protects a packed message: call it last, with its ..._CRC_START. */
static inline void emb_protect(uint8_t start, uint8_t *message, size_t size)
{{
    message[0] = emb_crc(start, message + 1, size - 1);
}}

/* True if CRC, counter and reserved bits of a received message are right. Check its length before, and its signals
 * with their ..._is_in_range after: a message of which anything is wrong is not obeyed. */
static inline bool emb_is_valid(uint8_t start, uint64_t reserved, const uint8_t *message, size_t size)
{{
    if (message[0] != emb_crc(start, message + 1, size - 1) || (message[1] & 0x0Fu) >= EMB_COUNTER_MODULUS)
        return false;
    for (size_t i = 0; i < size; i++)
        if (message[i] & (uint8_t)(reserved >> (8 * i)))
            return false;
    return true;
}}

#endif
"""


def gateway_code(layout: Layout) -> dict[str, str]:
    """Texts of the C files, by file name."""
    header, source, _, _ = generate(
        parse(layout.text), NAME, f"{NAME}.h", f"{NAME}.c", "", use_round=True, node_name=NODE
    )
    messages = "\n".join(
        f"#define {message.name.upper()}_CRC_START (0x{message.crc_start:02x}u)\n"
        f"#define {message.name.upper()}_RESERVED (UINT64_C(0x{message.reserved:x}))"
        for message in layout.all_messages
    )
    protection = _E2E.format(
        protocol=layout.protocol_version, last=COUNTER_MODULUS - 1, modulus=COUNTER_MODULUS, messages=messages
    )
    return {f"{NAME}.h": header, f"{NAME}.c": source, f"{NAME}_e2e.h": protection}


def main() -> int:
    """Write the files."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("folder", type=Path)
    folder = p.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in gateway_code(load_layout()).items():
        (folder / name).write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
