"""How good an extremal is, each necessary condition as a number with its bound."""

from jaxguide.certificate.certified import Certified as Certified
from jaxguide.certificate.certified import certified as certified
from jaxguide.certificate.certified import uncertified as uncertified
from jaxguide.certificate.certify import certify as certify
from jaxguide.certificate.table import Certificate as Certificate
