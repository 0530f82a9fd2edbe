"""What a campaign file may say."""

import pytest

from hilctl.base.errors import ConfigError
from hilctl.base.yaml import Document
from hilctl.studies.campaign.file import CampaignFile
from tests.unit.studies.campaign.conftest import CAMPAIGN


def test_all_that_is_wrong_is_said_at_once_with_its_line():
    text = (
        CAMPAIGN + "order: sideways\nrepeat: 0\nreference_run: {evry: 3}\ncondition: {cycles: 1}\n"
    )
    with pytest.raises(ConfigError) as found:
        Document("few.yaml", text).validate(CampaignFile)
    said = str(found.value)
    for place in ("few.yaml:6: order:", "few.yaml:7: repeat:", "few.yaml:8: reference_run.evry"):
        assert place in said
    assert "few.yaml:8: reference_run.every: is required" in said
    assert "few.yaml:9: condition.cycles" in said


def test_the_least_that_it_must_say():
    config = Document("few.yaml", CAMPAIGN).validate(CampaignFile)
    assert (config.order, config.repeat, config.reference_run) == ("as_written", 1, None)
