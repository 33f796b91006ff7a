"""Receivers decode every packet in all tests, so that an error in the packets' encoder changes a run."""

from octoreplay.replay.exchange.packet_codec import PacketCodec

PacketCodec.always_decodes = True
