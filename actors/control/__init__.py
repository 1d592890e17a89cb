"""Control of live actors at run time: suspend, look at, change the state or the code of; as Erlang's `sys`."""
