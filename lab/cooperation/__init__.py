"""The benefit of a shared map: real agents and map server on recordings of one site."""
