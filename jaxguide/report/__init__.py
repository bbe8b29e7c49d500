"""A stored sweep as one HTML file that needs no network. Host only."""

from jaxguide.report.page import html as html
from jaxguide.report.page import write as write
