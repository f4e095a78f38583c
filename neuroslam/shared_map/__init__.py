"""One live map of many robots: messages, the journal of offers, their fold, and a robot's side."""

from neuroslam.shared_map.fold import Folded, fold
from neuroslam.shared_map.journal import Journal, Receipt
from neuroslam.shared_map.messages import Offer, decode, encode
from neuroslam.shared_map.robot import LiveRobot

__all__ = ["Folded", "Journal", "LiveRobot", "Offer", "Receipt", "decode", "encode", "fold"]
