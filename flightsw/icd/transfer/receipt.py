"""Receipts: what binds the answer about a file to that very file, its transfer, its store and the mission's key.

A sender with a store says the store's identity in a message to user of the metadata. The receiver then puts a receipt
into its Finished PDU, as the message of a filestore response: a digest that only the very file gives, and where it has
a key a tag that only the key gives. Byte table: README.md, "Receipts".
"""

import hashlib
import hmac
import struct
from collections.abc import Sequence
from enum import Enum

from spacepackets.cfdp.lv import CfdpLv
from spacepackets.cfdp.pdu import MetadataPdu
from spacepackets.cfdp.pdu.finished import FinishedParams
from spacepackets.cfdp.tlv import (
    FilestoreActionCode,
    FilestoreResponseStatusCode,
    FileStoreResponseTlv,
    MessageToUserTlv,
    TlvType,
)

from flightsw.icd.link.auth import Key

STORE_BYTES = 8
PREFIX = b"store"  # of the message to user
DIGEST_BYTES = TAG_BYTES = 16
RECEIPT_TEXT = struct.Struct(
    ">13s8sI32s"
)  # what is digested: purpose, store, transaction, SHA-256 of the file


class Verdict(Enum):
    """What the receiver's owner says about a whole, checked file. Only `STORED` is true."""

    STORED = b"obbgs stored "
    UNSTORED = b""  # not now: the disk refuses
    REJECTED = b"obbgs refused"  # it would not be taken the next time either

    def __bool__(self) -> bool:
        return self is Verdict.STORED


def answer_key(key: Key) -> bytes:
    """Return the key that authenticates receipts; it follows from the mission's key and opens no command."""
    return hmac.digest(key.secret, b"obbgs receipts", "sha256")


def store_message(store: bytes) -> MessageToUserTlv:
    """Return the metadata's message that says which store a file is from."""
    return MessageToUserTlv(PREFIX + store)


def store_of(metadata: MetadataPdu) -> bytes:
    """Return the identity of the store that a file is from, empty if the metadata does not say it."""
    for tlv in metadata.options_as_tlv() or []:
        if tlv.tlv_type == TlvType.MESSAGE_TO_USER and tlv.value[: len(PREFIX)] == PREFIX:
            store = bytes(tlv.value[len(PREFIX) :])
            if len(store) == STORE_BYTES:
                return store
    return b""


def receipt(verdict: Verdict, store: bytes, transaction: int, sha256: bytes, key: bytes | None) -> bytes:
    """Return the receipt for a file: 16 bytes of digest, and with a key 16 bytes of tag."""
    text = RECEIPT_TEXT.pack(verdict.value, store, transaction, sha256)
    digest = hashlib.sha256(text).digest()[:DIGEST_BYTES]
    return digest if key is None else digest + hmac.digest(key, text, "sha256")[:TAG_BYTES]


def attach(finished: FinishedParams, verdict: Verdict, made: bytes) -> None:
    """Put a receipt into a Finished PDU's parameters."""
    codes = FilestoreResponseStatusCode
    code = codes.CREATE_SUCCESS if verdict else codes.CREATE_NOT_ALLOWED
    action = FilestoreActionCode.CREATE_FILE_SNM
    finished.file_store_responses = [FileStoreResponseTlv(action, code, "", "", CfdpLv(made))]


def receipt_in(finished: FinishedParams) -> bytes:
    """Return the receipt in a Finished PDU's parameters, empty if there is none."""
    responses = finished.file_store_responses
    return bytes(responses[0].filestore_msg.value) if responses else b""


def fits(
    given: bytes, verdict: Verdict, store: bytes, transaction: int, sha256: bytes, keys: Sequence[bytes]
) -> bool:
    """Tell whether a receipt is for this file; where there are keys, one of them must have made it."""
    without_tag = receipt(verdict, store, transaction, sha256, None)
    if not keys:
        return hmac.compare_digest(given[:DIGEST_BYTES], without_tag)
    return any(hmac.compare_digest(given, receipt(verdict, store, transaction, sha256, key)) for key in keys)
